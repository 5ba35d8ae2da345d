"""The 3D scene: a frustum for each camera, and the starting viewpoint of visitors."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import cv2
import numpy as np
import viser
from numpy.typing import NDArray

from edge_server.fields import RefinesCameras, View
from edge_server.live.state import CameraView, EdgeState
from edge_server.page import page_constants as tuned
from edge_server.page.colors import HELD_OUT, RGB, age_color
from edge_server.page.viewpoint import VERTICAL_FOV_RAD, Viewpoint, initial_viewpoint
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pose

log = logging.getLogger(__name__)


@dataclass
class _CameraNode:
    """A camera's frustum, and its last sent state."""

    handle: Any
    pose: Pose
    color: RGB
    thumbnail_of: tuple[str, int] | None = None
    thumbnail_at: float = -1e9


class Scene:
    """Scene nodes shared by all visitors. One thread calls ``refresh``, a few times a second."""

    def __init__(self, server: viser.ViserServer, state: EdgeState) -> None:
        self._server = server
        self._state = state
        self._nodes: dict[str, _CameraNode] = {}
        self._viewpoint: Viewpoint | None = None
        self._placed_for = (0, False)  # number of cameras, and whether the field's box was known
        self._first_seen: float | None = None
        self._seen = 0
        self._seen_at = 0.0
        self._placed: dict[int, NDArray[np.float64]] = {}
        self._undecodable: set[str] = set()

    @property
    def viewpoint(self) -> Viewpoint | None:
        """Where visitors begin; None while it is not known."""
        return self._viewpoint

    def refresh(self, cameras: list[CameraView], watched: bool) -> None:
        """Bring the scene up to date if there are visitors (``watched``)."""
        self._place_visitors(cameras)
        if self._viewpoint is None or not watched:
            return
        for camera in cameras:
            if camera.newest is not None:
                self._frustum(camera, camera.newest)
        self._thumbnails([c for c in cameras if c.newest is not None])

    # --- frustums -------------------------------------------------------------------------------

    def _frustum(self, camera: CameraView, frame: Frame) -> None:
        color = HELD_OUT if camera.held_out else age_color(camera.age_ms)
        node = self._nodes.get(camera.camera)
        if node is None:
            self._nodes[camera.camera] = self._add(camera, frame, color)
            return
        if frame.pose != node.pose:
            node.pose = frame.pose
            node.handle.wxyz = frame.pose.quaternion
            node.handle.position = frame.pose.translation_m
        if color != node.color:
            node.color = color
            node.handle.color = color

    def _add(self, camera: CameraView, frame: Frame, color: RGB) -> _CameraNode:
        assert self._viewpoint is not None
        k, size = frame.intrinsics, self._viewpoint.radius_m * tuned.FRUSTUM_OF_RADIUS
        handle = self._server.scene.add_camera_frustum(
            f"/cameras/{camera.camera}",
            fov=float(2 * np.arctan(0.5 * k.height / k.fy)),
            aspect=k.width / k.height,
            scale=size,
            thickness=3.0 if camera.held_out else 2.0,
            thickness_units="screen",
            color=color,
            format="jpeg",
            jpeg_quality=tuned.THUMBNAIL_JPEG_QUALITY,
            wxyz=frame.pose.quaternion,
            position=frame.pose.translation_m,
            cast_shadow=False,
            receive_shadow=False,
        )
        handle.on_click(lambda event: self._look_through(event.client, camera.camera))
        if camera.held_out:
            _, height, depth = handle.compute_canonical_frustum_size()
            above = (0.0, -0.75 * height * size, depth * size)
            self._server.scene.add_label(
                f"/cameras/{camera.camera}/label",
                "held out: ground truth",
                anchor="bottom-center",
                position=above,
                font_screen_scale=0.85,
            )
        return _CameraNode(handle, frame.pose, color)

    def _look_through(self, client: Any, camera: str) -> None:
        """Move a visitor to a camera's pose and field of view."""
        found = next((c for c in self._state.cameras() if c.camera == camera), None)
        if found is None or found.newest is None or self._viewpoint is None:
            return
        frame = found.newest
        pose = self._believed(frame)
        with client.atomic():
            client.camera.position = pose[:3, 3]
            client.camera.look_at = pose[:3, 3] + pose[:3, 2] * self._viewpoint.radius_m
            client.camera.up_direction = -pose[:3, 1]
            client.camera.fov = float(2 * np.arctan(0.5 * frame.intrinsics.height / frame.intrinsics.fy))

    def _believed(self, frame: Frame) -> NDArray[np.float64]:
        """The field's estimate of a frame's pose: its renderings fit the poses that it has refined."""
        pose, shown = frame.pose.matrix(), self._state.renderer
        if not isinstance(shown, RefinesCameras):
            return pose
        nothing = np.zeros((0, 0, 3), np.uint8)
        known = shown.correction(View(frame.camera, nothing, pose, frame.intrinsics, frame.generated_edge_ns))
        return pose if known is None else known.camera_to_world

    def _thumbnails(self, cameras: list[CameraView]) -> None:
        """Update thumbnails within the time budget, oldest first."""
        began = perf_counter()
        for camera in sorted(cameras, key=lambda each: self._nodes[each.camera].thumbnail_at):
            frame, node, now = camera.newest, self._nodes[camera.camera], perf_counter()
            assert frame is not None
            if now - began > tuned.THUMBNAIL_BUDGET_S:
                return
            key = (frame.session, frame.sequence)
            if key == node.thumbnail_of or now - node.thumbnail_at < tuned.THUMBNAIL_EVERY_S:
                continue
            node.thumbnail_of, node.thumbnail_at = key, now
            image = thumbnail(frame)
            if image is not None:
                node.handle.image = image
            elif camera.camera not in self._undecodable:
                self._undecodable.add(camera.camera)
                log.warning("page: the newest frame of %s cannot be decoded", camera.camera)

    # --- the starting viewpoint -----------------------------------------------------------------

    def _place_visitors(self, cameras: list[CameraView]) -> None:
        """Choose the starting viewpoint when cameras have reported, again while more of them do, and once the field
        knows its box."""
        poses = [c.newest.pose.matrix() for c in cameras if c.newest is not None]
        now = perf_counter()
        if not poses:
            return
        if self._first_seen is None:
            self._first_seen = now
        if len(poses) > self._seen:
            self._seen, self._seen_at = len(poses), now
        complete = len(poses) == len(cameras) or now - self._seen_at > tuned.QUIET_S
        box = getattr(self._state.renderer, "box", None)
        known = (len(poses), box is not None)
        early = self._viewpoint is None or now - self._first_seen < tuned.SETTLE_S
        if known > self._placed_for and complete and early:
            self._placed_for = known
            self._viewpoint = initial_viewpoint(np.stack(poses), None if box is None else box.center_m)
            start, view = self._server.initial_camera, self._viewpoint
            self._server.scene.set_up_direction(view.up)
            start.position, start.look_at, start.up = view.position, view.look_at, view.up
            start.fov = VERTICAL_FOV_RAD
            size = view.radius_m * tuned.FRUSTUM_OF_RADIUS
            for node in self._nodes.values():
                node.handle.scale = size
        if self._viewpoint is None:  # more cameras may report: visitors wait
            return
        for number, client in self._server.get_clients().items():
            self._place(number, client)

    def _place(self, number: int, client: Any) -> None:
        """Move a visitor to the starting viewpoint unless they have moved themselves."""
        assert self._viewpoint is not None
        wanted, last = self._viewpoint.position, self._placed.get(number)
        if last is not None and np.allclose(last, wanted):
            return
        tolerance = 1e-3 * self._viewpoint.radius_m
        if last is not None and not np.allclose(client.camera.position, last, atol=tolerance):
            return
        self._placed[number] = wanted
        with client.atomic():
            client.camera.position = wanted
            client.camera.look_at = self._viewpoint.look_at
            client.camera.up_direction = self._viewpoint.up
            client.camera.fov = VERTICAL_FOV_RAD

    def remove_client(self, client: Any) -> None:
        self._placed.pop(client.client_id, None)


def thumbnail(frame: Frame) -> NDArray[np.uint8] | None:
    """The frame's image as RGB, ``THUMBNAIL_WIDTH`` wide; None if it does not decode."""
    k = frame.intrinsics
    try:
        image = payload.decode(frame.payload, frame.codec, k.width, k.height)[..., :3]
    except payload.PayloadError:
        return None
    height = max(1, round(tuned.THUMBNAIL_WIDTH * k.height / k.width))
    if k.width <= tuned.THUMBNAIL_WIDTH:
        return np.ascontiguousarray(image)
    small = cv2.resize(np.ascontiguousarray(image), (tuned.THUMBNAIL_WIDTH, height), interpolation=cv2.INTER_AREA)
    return small.astype(np.uint8)
