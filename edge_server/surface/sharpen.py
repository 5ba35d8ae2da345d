"""Depth maps made sharper by the pictures themselves, before they are fused.

A field is fitted to colours: where a surface has little texture its depth may be off by many pixels without
the pictures showing it. Here every pixel's depth is moved to where other cameras' pictures agree with its own
(plane sweep in the manner of multi-view stereo; PGSR, Chen et al. 2024, adds the same comparison to its
loss), first far and coarsely, then near and finely, with the normals found so far. Pixels whose depth no
other map confirms count for little. The field's part is what stereo lacks: a first depth nearly right
everywhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool, shared_pool
from edge_server.surface import SurfaceError
from edge_server.surface.depth import DepthMap, depth_map
from edge_server.surface.kernels.sweep import Others, sweep

OTHERS = 4  # pictures that each is compared with
# Share of the depth that is searched to both sides, and in how many steps, pass by pass.
PASSES = ((0.08, 17), (0.03, 17), (0.012, 13), (0.004, 9))
BEST_DEG, LEAST_DEG, MOST_DEG = 25.0, 4.0, 65.0  # between two cameras' lines of sight
SMOOTH_PX = 2.5  # radius over which normals are found
AGREES = 0.5  # correlation from which on a place is believed
CONFIRMED = 0.004  # of the distance, beside a pixel, within which another map has the same surface
ENOUGH = 0.05  # share of good pixels around a bad one from which on it goes by them
ALONE = 0.1  # trust of a pixel whose surface no other map has, beside 1
UNSURE = 0.05  # trust of a pixel whose patch is flat, beside 1


def sharpened(
    maps: Sequence[DepthMap],
    pictures: Sequence[NDArray[np.uint8]],
    passes: Sequence[tuple[float, int]] = PASSES,
    pool: Pool | None = None,
    on_map: Callable[[float], None] | None = None,
) -> list[DepthMap]:
    """``maps`` with better depth. pictures: what the cameras took, uint8 (H, W, 3 or 4) each. on_map: told
    the share that is done. SurfaceError: pictures that are not the maps'."""
    if len(maps) != len(pictures):
        raise SurfaceError(f"{len(pictures)} pictures do not belong to {len(maps)} depth maps")
    pool = pool or shared_pool()
    greys = [_grey(picture, found) for picture, found in zip(pictures, maps)]
    chosen = [neighbours(maps, k) for k in range(len(maps))]
    now, scores = list(maps), [np.zeros(m.depth.shape, np.float32) for m in maps]
    for number, (share, steps) in enumerate(passes):
        factors = 1.0 + np.linspace(-share, share, steps)
        for k, found in enumerate(now):
            if chosen[k]:
                depth, scores[k] = _swept(found, greys, now, k, chosen[k], factors, pool)
                if number < len(passes) - 1:
                    depth = _settled(depth, found.seen, scores[k])
                now[k] = replace(found, depth=np.where(found.seen, depth, found.depth))
            if on_map is not None:
                on_map((number + (k + 1) / len(now)) / len(passes))
    return confirmed([_weighed(m, score) for m, score in zip(now, scores)], chosen)


def neighbours(maps: Sequence[DepthMap], k: int) -> list[int]:
    """The maps to compare map k with: those that look at the same place from ``BEST_DEG`` or so aside."""
    points = maps[k].points()
    if not len(points):
        return []
    middle = np.median(points, axis=0)
    ranked = []
    for j, other in enumerate(maps):
        if j == k:
            continue
        ways = [m.camera_to_world[:3, 3] - middle for m in (maps[k], other)]
        ways = [w / np.linalg.norm(w) for w in ways]
        apart = float(np.rad2deg(np.arccos(np.clip(ways[0] @ ways[1], -1.0, 1.0))))
        pose, lens = other.camera_to_world, other.intrinsics
        with np.errstate(invalid="ignore"):
            at = lens.project((points[:: max(1, len(points) // 500)] - pose[:3, 3]) @ pose[:3, :3])
            share = float(((at >= 0) & (at < (lens.width, lens.height))).all(axis=1).mean())
        if share > 0.2 and LEAST_DEG <= apart <= MOST_DEG:
            ranked.append((-share * np.exp(-(((apart - BEST_DEG) / 15.0) ** 2)), j))
    return [j for _, j in sorted(ranked)[:OTHERS]]


def confirmed(maps: Sequence[DepthMap], chosen: Sequence[Sequence[int]]) -> list[DepthMap]:
    """``maps`` in which pixels that none of the maps ``chosen`` for theirs has on its surface count by
    ``ALONE``."""
    out = []
    for k, found in enumerate(maps):
        points = found.points()
        agree = np.zeros(len(points), np.bool_)
        for j in chosen[k]:
            agree |= shows(maps[j], points, CONFIRMED)
        alone = np.zeros(found.depth.shape, np.bool_)
        alone[found.seen] = ~agree
        out.append(replace(found, trust=np.where(alone, np.float32(ALONE) * found.trust, found.trust)))
    return out


def shows(found: DepthMap, points: NDArray[np.float64], within: float) -> NDArray[np.bool_]:
    """Whether a depth map has each of the points (N, 3) on its surface. within: share of the distance."""
    lens, pose = found.intrinsics, found.camera_to_world
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(invalid="ignore"):
        at = lens.project(local)
        inside = np.all((at >= 0) & (at < (lens.width, lens.height)), axis=1)
    column, row = np.where(inside[:, None], at, 0.0).astype(np.int64).T
    distance = np.linalg.norm(local, axis=1)
    shown = np.where(found.seen, found.depth, 0.0)[row, column]
    # The nearest pixel's ray may meet a steep surface a pixel's width nearer or farther.
    tolerance = (within + 1.0 / min(lens.fx, lens.fy)) * distance
    agree: NDArray[np.bool_] = inside & (np.abs(shown - distance) <= tolerance)
    return agree


def _grey(picture: NDArray[np.uint8], found: DepthMap) -> NDArray[np.float32]:
    if picture.shape[:2] != found.depth.shape:
        raise SurfaceError(f"a picture of {picture.shape} does not belong to a depth map {found.depth.shape}")
    return cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2GRAY).astype(np.float32)


def _swept(
    found: DepthMap,
    greys: Sequence[NDArray[np.float32]],
    maps: Sequence[DepthMap],
    k: int,
    chosen: Sequence[int],
    factors: NDArray[np.float64],
    pool: Pool,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    pose = found.camera_to_world
    rays = np.ascontiguousarray(found.intrinsics.rays() @ pose[:3, :3].T)
    size = np.array([[maps[j].intrinsics.width, maps[j].intrinsics.height] for j in chosen], np.int64)
    others = Others(
        lens=np.array([lens_row(maps[j].intrinsics) for j in chosen], dtype=np.float64),
        rotation=np.stack([maps[j].camera_to_world[:3, :3] for j in chosen]),
        origin=np.stack([maps[j].camera_to_world[:3, 3] for j in chosen]),
        first=np.concatenate([[0], np.cumsum(size[:, 0] * size[:, 1])]).astype(np.int64),
        size=size,
        grey=np.concatenate([greys[j].ravel() for j in chosen]),
    )
    known = np.where(found.seen, found.depth, np.float32(0.0))
    depth, score = np.zeros_like(known), np.zeros_like(known)
    pool.run(
        sweep, rays, np.ascontiguousarray(pose[:3, 3]), greys[k], known, smooth_normals(found, rays), others,
        factors, depth, score,
    )  # fmt: skip
    return depth, score


def smooth_normals(found: DepthMap, rays: NDArray[np.float64]) -> NDArray[np.float32]:
    """float32 (H, W, 3): unit normals in world axes of the plane that fits the pixels around each best, by
    their derivatives: found points are smoothed first, those that are not known left out."""
    seen = found.seen
    points = np.where(seen[..., None], rays * found.depth[..., None], 0.0)
    weight = cv2.GaussianBlur(seen.astype(np.float64), (0, 0), SMOOTH_PX)
    smooth = cv2.GaussianBlur(points, (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6)[..., None]
    normal = np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1.0), -rays)
    return normal.astype(np.float32)


def _settled(
    depth: NDArray[np.float32], seen: NDArray[np.bool_], score: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Depth for the next pass to start from: where pictures agree, without single pixels that went astray
    (the median of 5 x 5); where they do not, what lies between the pixels around that do."""
    known = cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    calm = np.where(known, cv2.medianBlur(depth, 5), depth)
    good = (seen & (score >= AGREES)).astype(np.float32)
    weight = cv2.GaussianBlur(good, (0, 0), SMOOTH_PX)
    between = cv2.GaussianBlur(good * calm, (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6)
    lost = seen & (good == 0) & (weight > ENOUGH)
    return np.where(lost, between, calm).astype(np.float32)


def _weighed(found: DepthMap, score: NDArray[np.float32]) -> DepthMap:
    """A depth map of the depth found, whose pixels count by how well pictures agree there."""
    sure = np.clip((score - AGREES) / (1.0 - AGREES), 0.0, 1.0)
    sure = np.where(score == 0.0, np.float32(UNSURE), sure)
    depth = np.where(found.seen & (sure <= 0.0), np.float32(0.0), found.depth)
    return depth_map(depth, found.color, found.camera_to_world, found.intrinsics, sure)
