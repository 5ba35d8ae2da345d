"""Depth maps of a field, with a weight (trust) for each pixel.

Every representation composites depth as a mean along the ray. At an occlusion edge, the mean lies in empty
space between the near and the far surface. Depth there changes more steeply from pixel to pixel than on any
surface at a useful angle; such pixels are discarded.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Renderer
from edge_server.surface import surface_constants as tuned
from freshfield.geometry import Pinhole

Camera = tuple[NDArray[np.float64], Pinhole]


@dataclass(frozen=True)
class DepthMap:
    """What one camera sees of a surface.

    depth: float32 (H, W), meters along the ray; 0: unknown, inf: the ray hits nothing.
    trust: float32 (H, W), weight (w_new of 3.9); 0: unknown.
    cosine: float32 (H, W), of the angle between ray and normal.
    color: uint8 (H, W, 3).
    camera_to_world: (4, 4), OpenCV axes, meters.
    """

    depth: NDArray[np.float32]
    trust: NDArray[np.float32]
    cosine: NDArray[np.float32]
    color: NDArray[np.uint8]
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole

    def points(self) -> NDArray[np.float64]:
        """World points (N, 3), meters, of the pixels that see a surface, row by row."""
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
) -> DepthMap:
    """A depth map from depth along rays. Trust is the cosine between ray and normal: uncertainty grows as the
    surface turns away.

    depth: float32 (H, W), meters; inf: the ray hits nothing; NaN, nonpositive or beyond ``MAX_DEPTH_M``:
        unknown.
    color: uint8 (H, W, 3). camera_to_world: (4, 4), OpenCV axes, meters.
    sure: float32 (H, W), factor of the trust of pixels that see a surface; None: 1.
    """
    pose = np.asarray(camera_to_world, dtype=np.float64)
    empty = np.isposinf(depth)
    depth = np.where((depth > 0) & (depth < tuned.MAX_DEPTH_M), depth, 0).astype(np.float32)
    cosine = incidence_cosine(depth, intrinsics)
    trust = cosine if sure is None else cosine * np.clip(np.nan_to_num(sure, nan=0.0), 0.0, 1.0)
    seen = cosine >= np.cos(np.deg2rad(tuned.STEEPEST_DEG))
    depth = np.where(seen, depth, np.where(empty, np.inf, 0.0)).astype(np.float32)
    trust = np.where(seen, trust, np.where(empty, tuned.EMPTY_TRUST, 0.0)).astype(np.float32)
    return DepthMap(depth, trust, np.where(empty, np.float32(1.0), cosine), color, pose, intrinsics)


def incidence_cosine(depth: NDArray[np.float32], intrinsics: Pinhole) -> NDArray[np.float32]:
    """Cosine between each ray and the surface normal, float32 (H, W); 0 if a neighbor that the normal needs
    has no depth."""
    if min(depth.shape) < 2:
        return np.zeros_like(depth)
    rays, known = intrinsics.rays(), depth > 0
    points = np.where(known[..., None], rays * depth[..., None].astype(np.float64), np.nan)
    normal = np.cross(np.gradient(points, axis=1), np.gradient(points, axis=0))
    length = np.linalg.norm(normal, axis=-1)
    along = np.abs((normal * rays).sum(axis=-1))
    sure = known & (length > 0)
    return np.where(sure, along / np.where(sure, length, 1.0), 0.0).astype(np.float32)


def render_depth_maps(
    renderer: Renderer,
    cameras: Sequence[Camera],
    solid: float = tuned.SOLID,
    on_map: Callable[[int], None] | None = None,
) -> Iterator[DepthMap]:
    """Render depth maps for ``cameras``, one at a time. For a ``planar`` renderer, ``render_surface`` gives
    unbiased depth.

    solid: least opacity of a ray that hits a surface. on_map: called with the count done.
    """
    show = renderer.render_surface if getattr(renderer, "planar", False) else renderer.render  # type: ignore[attr-defined]
    for k, (pose, lens) in enumerate(cameras):
        found = show(pose, lens)
        with np.errstate(invalid="ignore"):
            beyond = np.where(found.opacity <= tuned.EMPTY, np.inf, 0.0)
            depth = np.where(found.opacity >= solid, found.depth, beyond).astype(np.float32)
        color = np.rint(np.clip(np.nan_to_num(found.color), 0.0, 1.0) * 255.0).astype(np.uint8)
        yield depth_map(depth, color, pose, lens, found.opacity)
        if on_map is not None:
            on_map(k + 1)
