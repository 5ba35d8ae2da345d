"""Depth maps of what a field shows: where it is solid, how far, and how much each pixel is worth.

Every representation composites its depth as a mean along the ray. At the edge of what is near, a pixel's mean
lies between what is near and what is far, on nothing at all: there the depth falls so steeply from pixel to
pixel that no surface seen at a useful angle does, which is how such pixels are told and left out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Renderer
from edge_server.surface import SurfaceError
from freshfield.geometry import Pinhole

SOLID = 0.8  # opacity from which on a ray has met a surface
EMPTY = 0.1  # opacity up to which it has met nothing at all
EMPTY_TRUST = 0.25  # of a pixel whose ray meets nothing, beside 1 of one that meets a surface head-on
MOST_M = 1e6  # what is said to be farther is no depth
STEEPEST_DEG = 80.0  # between ray and normal: steeper is an edge, or of no use
Camera = tuple[NDArray[np.float64], Pinhole]


@dataclass(frozen=True)
class DepthMap:
    """depth: float32 (H, W), metres along the ray; 0 where nothing is known, inf where the ray meets nothing.
    trust: float32 (H, W), what a pixel counts for (w_new of 3.9), 0 where nothing is known. cosine: float32
    (H, W), of the angle between ray and normal. color: uint8 (H, W, 3). camera_to_world: (4, 4), OpenCV axes,
    metres."""

    depth: NDArray[np.float32]
    trust: NDArray[np.float32]
    cosine: NDArray[np.float32]
    color: NDArray[np.uint8]
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole

    def points(self) -> NDArray[np.float64]:
        """World metres (N, 3) of the pixels that see a surface, row by row."""
        pose, seen = self.camera_to_world, self.seen
        rays = self.intrinsics.rays()[seen] @ pose[:3, :3].T
        points: NDArray[np.float64] = pose[:3, 3] + rays * self.depth[seen, None].astype(np.float64)
        return points

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which pixels (H, W) see a surface."""
        found: NDArray[np.bool_] = (self.depth > 0) & (self.depth < np.inf)
        return found


def depth_map(
    depth: NDArray[np.float32],
    color: NDArray[np.uint8],
    camera_to_world: NDArray[np.float64],
    intrinsics: Pinhole,
    sure: NDArray[np.float32] | None = None,
    steepest_deg: float = STEEPEST_DEG,
) -> DepthMap:
    """A depth map from depth along rays (H, W), metres, inf where a ray meets nothing; what is no number, not
    positive or beyond ``MOST_M`` is not known. sure: float32 (H, W), a factor of the trust of pixels that see
    a surface. SurfaceError: shapes that do not belong together.

    A pixel counts by the cosine at which it sees the surface, which is how much smaller the surface's piece
    in it is: uncertainty grows as the surface turns away.
    """
    shape = (intrinsics.height, intrinsics.width)
    if depth.shape != shape or color.shape != (*shape, 3):
        raise SurfaceError(f"depth {depth.shape} and colour {color.shape} do not fit a camera of {shape}")
    pose = np.asarray(camera_to_world, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise SurfaceError("a depth map's camera_to_world must be a finite (4, 4) matrix")
    empty = np.isposinf(depth)
    depth = np.where((depth > 0) & (depth < MOST_M), depth, 0).astype(np.float32)
    cosine = incidence(depth, intrinsics)
    trust = cosine if sure is None else cosine * np.clip(np.nan_to_num(sure, nan=0.0), 0.0, 1.0)
    seen = cosine >= np.cos(np.deg2rad(steepest_deg))
    depth = np.where(seen, depth, np.where(empty, np.inf, 0.0)).astype(np.float32)
    trust = np.where(seen, trust, np.where(empty, EMPTY_TRUST, 0.0)).astype(np.float32)
    return DepthMap(depth, trust, np.where(empty, np.float32(1.0), cosine), color, pose, intrinsics)


def incidence(depth: NDArray[np.float32], intrinsics: Pinhole) -> NDArray[np.float32]:
    """float32 (H, W): cosine of the angle between each ray and the surface's normal there; 0 where a
    neighbour that the normal needs has no depth."""
    rays = intrinsics.rays()
    points = rays * depth[..., None].astype(np.float64)
    right, down = (_slope(points, depth > 0, axis) for axis in (1, 0))
    normal = np.cross(right, down)
    length = np.linalg.norm(normal, axis=-1)
    along = np.abs((normal * rays).sum(axis=-1))
    return np.where(length > 0, along / np.where(length > 0, length, 1.0), 0.0).astype(np.float32)


def _slope(points: NDArray[np.float64], known: NDArray[np.bool_], axis: int) -> NDArray[np.float64]:
    """How points (H, W, 3) change along an axis, from both neighbours, or from one at the border; 0 where a
    neighbour is not known."""
    step = np.diff(points, axis=axis)
    both = np.take(known, range(1, known.shape[axis]), axis) & np.take(
        known, range(known.shape[axis] - 1), axis
    )
    out = np.zeros_like(points)
    count = np.zeros(known.shape)
    after = [slice(None)] * 2
    before = [slice(None)] * 2
    after[axis], before[axis] = slice(1, None), slice(None, -1)
    for where in (tuple(after), tuple(before)):
        out[where] += step
        count[where] += both
    needed = np.full(known.shape, 2)
    edge = [slice(None)] * 2
    for end in (0, -1):
        edge[axis] = end  # type: ignore[call-overload]
        needed[tuple(edge)] = 1
    return np.where((count == needed)[..., None], out, 0.0)


def rendered(
    renderer: Renderer,
    cameras: Sequence[Camera],
    solid: float = SOLID,
    steepest_deg: float = STEEPEST_DEG,
    on_map: Callable[[int], None] | None = None,
) -> Iterator[DepthMap]:
    """Depth maps of what ``renderer`` shows to ``cameras``, one at a time. on_map: told how many are done.

    A renderer that is ``planar`` has an unbiased depth, which ``render_surface`` shows.
    """
    show = renderer.render_surface if getattr(renderer, "planar", False) else renderer.render  # type: ignore[attr-defined]
    for k, (pose, lens) in enumerate(cameras):
        found = show(pose, lens)
        with np.errstate(invalid="ignore"):
            beyond = np.where(found.opacity <= EMPTY, np.inf, 0.0)
            depth = np.where(found.opacity >= solid, found.depth, beyond).astype(np.float32)
        color = np.rint(np.clip(np.nan_to_num(found.color), 0.0, 1.0) * 255.0).astype(np.uint8)
        yield depth_map(depth, color, pose, lens, found.opacity, steepest_deg)
        if on_map is not None:
            on_map(k + 1)
