"""Checks views and packs them for the kernels: pixels, cameras in scene units, and what has moved."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import SceneBox
from freshfield.geometry import GeometryError, Pinhole, Pose, invertible
from freshfield.limits import MAX_CENTER_OUTSIDE_SIDES

# Limits beyond any real camera, within what float32 can represent: positions (geographic grids reach 1e7 m),
# and focal lengths as a share of the image's longer side.
FARTHEST_M = 1e9
FOCAL = (1e-3, 1e6)


@dataclass
class CameraMemory:
    """The newest view of one camera.

    moved: bool (H, W), the pixels that moved since the view before; None where that is unknown.
    """

    view: View
    moved: NDArray[np.bool_] | None = None


def lens_row(camera: Pinhole) -> list[float]:
    return [camera.fx, camera.fy, camera.cx, camera.cy, *camera.distortion]


def check_view(view: View) -> None:
    """ValueError for a view that would poison a field; it says which camera and why."""
    image, camera = view.image, view.intrinsics
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise ValueError(f"camera {view.camera}: image must be uint8 (H, W, 3 or 4), not {image.shape}")
    if image.shape[:2] != (camera.height, camera.width):
        raise ValueError(
            f"camera {view.camera}: image is {image.shape[1]} x {image.shape[0]}, "
            f"its intrinsics say {camera.width} x {camera.height}"
        )
    if np.shape(view.camera_to_world) != (4, 4) or not np.all(np.isfinite(view.camera_to_world)):
        raise ValueError(f"camera {view.camera}: camera_to_world must be a finite (4, 4) matrix")
    try:
        Pose.from_matrix(view.camera_to_world)
    except GeometryError as error:
        raise ValueError(f"camera {view.camera}: {error}") from None
    if np.abs(view.camera_to_world[:3, 3]).max() > FARTHEST_M:
        raise ValueError(f"camera {view.camera}: its position is more than {FARTHEST_M:g} m from the origin")
    shortest, longest = (limit * max(camera.width, camera.height) for limit in FOCAL)
    lens = np.array(lens_row(camera))
    if not np.isfinite(lens).all() or lens[:2].min() < shortest or lens[:2].max() > longest:
        raise ValueError(
            f"camera {view.camera}: focal lengths of {camera.fx:g} and {camera.fy:g} pixels are no lens "
            f"for an image of {camera.width} x {camera.height}, or its other numbers are not finite"
        )
    if np.abs(lens[2:4] / (camera.width, camera.height) - 0.5).max() > MAX_CENTER_OUTSIDE_SIDES + 0.5:
        raise ValueError(
            f"camera {view.camera}: its principal point of {camera.cx:g}, {camera.cy:g} is far outside "
            f"the image of {camera.width} x {camera.height}"
        )
    if not invertible(camera):
        raise ValueError(f"camera {view.camera}: its distortion cannot be undone over the whole image")
    for name, array in (("weight", view.weight), ("depth", view.depth)):
        if array is not None and not (array.dtype == np.float32 and array.shape == image.shape[:2]):
            raise ValueError(
                f"camera {view.camera}: {name} must be float32 of shape {image.shape[:2]}, "
                f"not {array.dtype} of shape {array.shape}"
            )
    if view.weight is not None and not ((view.weight >= 0.0) & (view.weight <= 1.0)).all():  # nor of NaN
        raise ValueError(f"camera {view.camera}: weight must be within 0..1")


def moved_pixels(before: View, now: View) -> NDArray[np.bool_] | None:
    """Where a camera sees a change, bool (H, W); None if nothing moved, or the camera did."""
    if before.image.shape != now.image.shape or before.intrinsics != now.intrinsics:
        return None
    if not np.allclose(before.camera_to_world, now.camera_to_world, atol=1e-6):
        return None
    difference = cv2.absdiff(cv2.blur(before.image, (3, 3)), cv2.blur(now.image, (3, 3)))
    channels = cv2.split(difference)  # a maximum along so short an axis takes numpy ten times as long
    most = channels[0]
    for channel in channels[1:]:
        most = cv2.max(most, channel)
    moved = (most > tuned.CHANGE).astype(np.uint8)
    if not moved.any():
        return None
    size = 2 * tuned.MARGIN_PX + 1
    return cv2.dilate(moved, np.ones((size, size), np.uint8)).astype(bool)


def remember_views(memory: dict[str, CameraMemory], views: Sequence[View]) -> tuple[bool, bool]:
    """Store the newest view of each camera. Returns whether a camera is new, has moved or has a new lens, and whether
    an image was not known before."""
    news = fresh = False
    for view in views:
        known = memory.get(view.camera)
        if known is not None and known.view is view:
            continue
        stood = known is not None and (
            known.view.intrinsics == view.intrinsics
            and np.allclose(known.view.camera_to_world, view.camera_to_world, atol=tuned.SAME_POSE)
        )
        news = news or not stood
        moved, same = None, False
        if known is not None:
            # The same frame decoded once more is no news; an equal but newer one says that nothing moved.
            # Otherwise pixels that one wrong picture changed would count as moving while the scene stands.
            same = known.view.generated_ns == view.generated_ns and np.array_equal(known.view.image, view.image)
            moved = known.moved if same else moved_pixels(known.view, view)
        fresh = fresh or not same
        memory[view.camera] = CameraMemory(view, moved)
    return news, fresh


def pack_cameras(views: Sequence[View], box: SceneBox) -> Views:
    """The cameras of ``views`` in scene units, without pixels."""
    size = np.array([[v.intrinsics.width, v.intrinsics.height] for v in views], dtype=np.int64)
    pose = np.stack([np.asarray(v.camera_to_world, dtype=np.float64) for v in views])
    return Views(
        first=np.concatenate([[0], np.cumsum(size[:, 0] * size[:, 1])]).astype(np.int64),
        size=size,
        lens=np.array([lens_row(v.intrinsics) for v in views], dtype=np.float64),
        rotation=np.ascontiguousarray(pose[:, :3, :3]),
        origin=np.ascontiguousarray(box.normalise(pose[:, :3, 3])),
        pixels=np.zeros((0, 3), np.uint8),
        changed=np.zeros(0, np.int64),
    )


def pack_views(views: Sequence[View], box: SceneBox, memory: dict[str, CameraMemory]) -> Views:
    """Everything one fit reads. Opaque and transparent pictures may be mixed.

    memory: camera -> its newest view, and which of its pixels moved.
    """
    packed = pack_cameras(views, box)
    channels = max(v.image.shape[2] for v in views)
    pixels = np.full((int(packed.first[-1]), channels), 255, np.uint8)
    changed = []
    for k, view in enumerate(views):
        a, b = packed.first[k], packed.first[k + 1]
        pixels[a:b, : view.image.shape[2]] = view.image.reshape(int(b - a), -1)
        known = memory.get(view.camera)
        if known is not None and known.view is view and known.moved is not None:
            changed.append(a + np.flatnonzero(known.moved))
    moved = np.concatenate(changed) if changed else np.zeros(0, np.int64)
    packed = packed._replace(pixels=pixels, changed=moved)
    if all(v.weight is None or bool((v.weight == 1.0).all()) for v in views):
        return packed
    ones = [np.ones(v.image.shape[:2], np.float32) if v.weight is None else v.weight for v in views]
    weight = np.concatenate([w.reshape(-1) for w in ones])
    drawn = np.flatnonzero(weight)
    return packed._replace(
        changed=moved[weight[moved] > 0],
        weight=weight,
        drawn=drawn if drawn.size < weight.size else np.zeros(0, np.int64),
    )


def supervising_views(data: Views) -> list[int]:
    """The numbers of the views that have pixels of weight above 0."""
    spans = zip(data.first[:-1], data.first[1:])
    return [k for k, (a, b) in enumerate(spans) if not data.weight.size or data.weight[a:b].any()]
