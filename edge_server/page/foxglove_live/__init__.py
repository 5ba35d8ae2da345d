"""A live server for Foxglove (extra ``foxglove``), on this machine alone: what the page shows, in Foxglove's schemas.

    /CAMERA/image          CompressedImage    its newest frame, as received; zstd becomes JPEG
    /CAMERA/calibration    CameraCalibration  with each frame; OpenCV's pixel origin
    /tf                    FrameTransform     world -> CAMERA, world -> rendered; axes as OpenCV's
    /truth/image           CompressedImage    the newest frame of the first held-out camera, else of the first
    /rendered/image        CompressedImage    the field at this instant, from the pose of that frame
    /rendered/calibration  CameraCalibration
    /points                PointCloud         centers and colors of static Gaussians, where the field has any
    /ages                  JSON               seconds since the newest frame of each camera; their least and most
    /decisions             JSON               each update of the field, when published
    /scores                JSON               the same with its fidelity, when that is known

Messages are made only for topics with subscribers. Stamps are capture times on the edge's clock.
``deploy/foxglove-layout.json`` is a layout to import.
"""

from __future__ import annotations

import logging
from dataclasses import asdict
from time import perf_counter
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Snapshot
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, POSITION, SCALE
from edge_server.fields.splat.layers.snapshot import LayeredSnapshot
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.live.state import CameraView, EdgeState, Publication
from edge_server.page.foxglove_live import foxglove_constants as tuned
from edge_server.page.page_constants import PICTURE_JPEG_QUALITY
from edge_server.page.page_thread import PageThread
from edge_server.page.rendering import browser_image
from edge_server.page.splats.records import weights
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose
from freshfield.transport import TransportError

log = logging.getLogger(__name__)

WORLD, RENDERED, TRUTH = "world", "rendered", "truth"
_NUMBER = {"type": "number"}
_AGES = {
    "title": "freshfield.Ages",
    "type": "object",
    "properties": {
        "cameras": {"type": "object", "additionalProperties": _NUMBER},
        "least_s": _NUMBER,
        "most_s": _NUMBER,
    },
}
_VIEWED = ("jpeg", "png")


class FoxgloveServer(PageThread):
    """Serves ``state`` on ``port`` of 127.0.0.1 until stopped; port 0 takes a free one. url: for Foxglove's "Open
    connection". Raises TransportError without the extra, or if the port is taken."""

    def __init__(self, state: EdgeState, port: int) -> None:
        super().__init__("foxglove", "serving Foxglove")
        try:
            import foxglove
            from foxglove import Channel, Context, channels
        except ImportError:
            raise TransportError("--foxglove-port needs pip install 'freshfield[foxglove]'") from None
        self._state = state
        self._context = context = Context()  # kept: channels end with it
        self._fox = foxglove.messages
        self._cameras = [camera.camera for camera in state.cameras()]
        decision = {
            **msgspec.json.schema_components([Publication])[1][Publication.__name__],
            "title": "freshfield.Decision",
        }

        def each(kind: Any, name: str) -> dict[str, Any]:
            return {at: kind(f"/{at}/{name}", context=context) for at in (*self._cameras, RENDERED)}

        self._images = each(channels.CompressedImageChannel, "image")
        self._lenses = each(channels.CameraCalibrationChannel, "calibration")
        self._truth = channels.CompressedImageChannel(f"/{TRUTH}/image", context=context)
        self._moved = channels.FrameTransformChannel("/tf", context=context)
        self._points = channels.PointCloudChannel("/points", context=context)
        self._ages = Channel("/ages", schema=_AGES, context=context)
        self._decisions = Channel("/decisions", schema=decision, context=context)
        self._scores = Channel("/scores", schema=decision, context=context)
        self._all = [*self._images.values(), *self._lenses.values(), self._truth, self._moved, self._points]
        self._all += [self._ages, self._decisions, self._scores]
        self._sent: dict[str, tuple[str, int]] = {}
        self._last_decision = -1
        self._last_score: Publication | None = None
        self._render_due_s = self._points_due_s = 0.0
        try:
            self._server = foxglove.start_server(
                name=f"freshfield {state.scenario}",
                host="127.0.0.1",
                port=port,
                context=context,
                message_backlog_size=tuned.BACKLOG,
            )
        except RuntimeError as error:
            raise TransportError(f"--foxglove-port {port}: {error}") from None
        self.url = f"ws://127.0.0.1:{self._server.port}"
        self.start()

    def stop(self) -> None:
        super().stop()
        self._server.stop()

    def _step(self) -> float:
        if not any(channel.has_sinks() for channel in self._all):
            return tuned.IDLE_S
        self._send()
        return tuned.TICK_S

    def _send(self) -> None:
        """Send new messages on the topics with subscribers."""
        cameras = [camera for camera in self._state.cameras() if camera.newest is not None]
        seen_from = next((c for c in cameras if c.held_out), cameras[0] if cameras else None)
        fresh = [c for c in cameras if c.newest is not None and self._sent.get(c.camera) != _key(c.newest)]
        for camera in fresh:
            assert camera.newest is not None
            self._sent[camera.camera] = _key(camera.newest)
            self._frame(camera.camera, camera.newest, camera is seen_from)
        if fresh and self._ages.has_sinks():
            ages_s = {c.camera: c.age_ms / 1e3 for c in cameras if c.age_ms is not None}
            bounds = {"least_s": min(ages_s.values()), "most_s": max(ages_s.values())} if ages_s else {}
            self._ages.log({"cameras": ages_s, **bounds}, log_time=self._state.now_ns())
        self._publications()
        now_s, field = perf_counter(), self._state.renderer
        if field is None:
            return
        if now_s >= self._points_due_s and self._points.has_sinks():
            self._points_due_s = now_s + tuned.POINTS_EVERY_S
            self._send_points(field)
        asked = self._images[RENDERED].has_sinks() or self._lenses[RENDERED].has_sinks()
        if asked and now_s >= self._render_due_s and seen_from is not None:
            self._render_due_s = now_s + tuned.RENDER_EVERY_S  # also if it fails
            self._send_rendering(field, seen_from)
            spent = perf_counter() - now_s
            self._render_due_s = now_s + max(tuned.RENDER_EVERY_S, spent / tuned.RENDER_SHARE)

    def _frame(self, camera: str, frame: Frame, truth: bool) -> None:
        t_ns = frame.generated_edge_ns
        self._send_pose(camera, frame.pose, t_ns)
        self._send_lens(camera, frame.intrinsics, t_ns)
        channels = [c for c in (self._images[camera], *([self._truth] if truth else [])) if c.has_sinks()]
        if channels:
            data, form = frame.payload, frame.codec
            if form not in _VIEWED:
                k = frame.intrinsics
                pixels = np.ascontiguousarray(payload.decode(data, form, k.width, k.height)[..., :3])
                data, form = payload.encode(pixels, "jpeg", PICTURE_JPEG_QUALITY), "jpeg"
            for channel in channels:
                stamp = self._stamp(t_ns)
                image = self._fox.CompressedImage(timestamp=stamp, frame_id=camera, data=data, format=form)
                channel.log(image, log_time=t_ns)

    def _publications(self) -> None:
        if self._decisions.has_sinks():
            for publication in self._state.publications(self._last_decision)[-tuned.BACKLOG :]:
                self._last_decision = publication.number
                self._decisions.log(asdict(publication), log_time=publication.published_ns)
        scored = self._state.newest(scored=True)
        # Of several held-out cameras each changes the score of the same update.
        if scored is not None and scored is not self._last_score and self._scores.has_sinks():
            self._last_score = scored
            self._scores.log(asdict(scored), log_time=self._state.now_ns())

    def _send_rendering(self, field: Snapshot, camera: CameraView) -> None:
        frame, now_ns = camera.newest, self._state.now_ns()
        assert frame is not None
        k = frame.intrinsics
        lens = Pinhole(k.width, k.height, k.fx, k.fy, k.cx, k.cy).scaled(min(1.0, tuned.MOST_ROWS / k.height))
        shown = field.at(now_ns).render(frame.pose.matrix(), lens)
        data = payload.encode(browser_image(shown.color), "jpeg", PICTURE_JPEG_QUALITY)
        self._send_pose(RENDERED, frame.pose, now_ns)
        self._send_lens(RENDERED, lens, now_ns)
        image = self._fox.CompressedImage(timestamp=self._stamp(now_ns), frame_id=RENDERED, data=data, format="jpeg")
        self._images[RENDERED].log(image, log_time=now_ns)

    def _send_points(self, field: Snapshot) -> None:
        points, now_ns, fox = point_cloud(field), self._state.now_ns(), self._fox
        if points is None:
            return
        kinds = {"f": fox.PackedElementFieldNumericType.Float32, "u": fox.PackedElementFieldNumericType.Uint8}
        assert points.dtype.fields is not None
        fields = [
            fox.PackedElementField(name=name, offset=offset, type=kinds[dtype.kind])
            for name, (dtype, offset, *_) in points.dtype.fields.items()
        ]
        cloud = fox.PointCloud(
            timestamp=self._stamp(now_ns),
            frame_id=WORLD,
            pose=fox.Pose(position=fox.Vector3(), orientation=fox.Quaternion(w=1.0)),
            point_stride=points.dtype.itemsize,
            fields=fields,
            data=points.tobytes(),
        )
        self._points.log(cloud, log_time=now_ns)

    def _send_pose(self, child: str, pose: Pose, t_ns: int) -> None:
        if self._moved.has_sinks():
            (w, x, y, z), (tx, ty, tz) = pose.quaternion, pose.translation_m
            transform = self._fox.FrameTransform(
                timestamp=self._stamp(t_ns),
                parent_frame_id=WORLD,
                child_frame_id=child,
                translation=self._fox.Vector3(x=tx, y=ty, z=tz),
                rotation=self._fox.Quaternion(x=x, y=y, z=z, w=w),
            )
            self._moved.log(transform, log_time=t_ns)

    def _send_lens(self, frame: str, lens: Pinhole, t_ns: int) -> None:
        channel = self._lenses[frame]
        if channel.has_sinks():
            k, d = lens.opencv()
            calibration = self._fox.CameraCalibration(
                timestamp=self._stamp(t_ns),
                frame_id=frame,
                width=lens.width,
                height=lens.height,
                distortion_model="plumb_bob",
                D=[*map(float, d.ravel()[:4]), 0.0],
                K=[*map(float, k.ravel())],
                R=[*map(float, np.eye(3).ravel())],
                P=[*map(float, np.hstack([k, np.zeros((3, 1))]).ravel())],
            )
            channel.log(calibration, log_time=t_ns)

    def _stamp(self, t_ns: int) -> Any:
        return self._fox.Timestamp(sec=t_ns // 10**9, nsec=t_ns % 10**9)


def point_cloud(field: Snapshot) -> NDArray[np.void] | None:
    """Centers (world, meters) and colors of the most visible static Gaussians; None: the field has none."""
    if not isinstance(field, SplatSnapshot):
        return None
    static = field.static if isinstance(field, LayeredSnapshot) else None
    params = field.params if static is None else static
    weight = weights(params) * (params[:, OPACITY] > np.log(tuned.LEAST_OPACITY / (1.0 - tuned.LEAST_OPACITY)))
    chosen = np.argsort(-weight, kind="stable")[: min(tuned.MOST_POINTS, int((weight > 0).sum()))]
    kinds = [(name, "<f4") for name in "xyz"] + [(name, "u1") for name in ("red", "green", "blue", "alpha")]
    points = np.zeros(len(chosen), kinds)
    at = params[chosen, POSITION:SCALE] * field.box.radius_m + np.asarray(field.box.center_m)
    color = np.rint(255 * np.clip(params[chosen, COLOR:BASE], 0, 1))
    for k in range(3):
        points["xyz"[k]], points[("red", "green", "blue")[k]] = at[:, k], color[:, k]
    points["alpha"] = 255
    return points


def _key(frame: Frame) -> tuple[str, int]:
    return frame.session, frame.sequence
