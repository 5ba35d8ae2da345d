"""Refine depth maps by photo-consistency before fusion.

A field is fitted to colors, so its depth may be off by many pixels where a surface has little texture. This
moves every pixel's depth to where other cameras' images agree with its own (plane sweep as in multi-view
stereo; PGSR, Chen et al. 2024, has the same comparison in its loss), from coarse to fine, with the current
normals. Pixels whose depth no other map confirms get a low weight. The field provides what stereo lacks: an
initial depth nearly right everywhere.
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
from edge_server.surface.kernels.sweep import SourceImages, sweep

OTHERS = 4  # images to compare each image with
# Per pass: search range to each side, as a share of the depth, and number of steps.
PASSES = ((0.08, 17), (0.03, 17), (0.012, 13), (0.004, 9))
BEST_DEG, LEAST_DEG, MOST_DEG = 25.0, 4.0, 65.0  # between two cameras' lines of sight
SMOOTH_PX = 2.5  # sigma of the Gaussian blur for normals
AGREES = 0.5  # minimum correlation of a reliable depth
CONFIRMED = 0.004  # tolerance of another map's surface, share of the distance, plus one pixel
ENOUGH = 0.05  # minimum share of good pixels around a bad one to interpolate from them
ALONE = 0.1  # factor of the trust of a pixel that no other map confirms
UNSURE = 0.05  # factor of the trust of a pixel with a flat patch


def refine_depth(
    maps: Sequence[DepthMap],
    pictures: Sequence[NDArray[np.uint8]],
    passes: Sequence[tuple[float, int]] = PASSES,
    pool: Pool | None = None,
    on_map: Callable[[float], None] | None = None,
) -> list[DepthMap]:
    """Refine the depth of ``maps``. pictures: camera images, uint8 (H, W, 3 or 4) each. on_map: called with
    the completed share. SurfaceError: the images do not match the maps."""
    if len(maps) != len(pictures):
        raise SurfaceError(f"{len(pictures)} pictures do not belong to {len(maps)} depth maps")
    pool = pool or shared_pool()
    greys = [_grey(picture, found) for picture, found in zip(pictures, maps)]
    chosen = [neighboring_maps(maps, k) for k in range(len(maps))]
    now, scores = list(maps), [np.zeros(m.depth.shape, np.float32) for m in maps]
    for number, (share, steps) in enumerate(passes):
        factors = 1.0 + np.linspace(-share, share, steps)
        for k, found in enumerate(now):
            if chosen[k]:
                depth, scores[k] = _sweep_map(found, greys, now, k, chosen[k], factors, pool)
                if number < len(passes) - 1:
                    depth = _filter_depth(depth, found.seen, scores[k])
                now[k] = replace(found, depth=np.where(found.seen, depth, found.depth))
            if on_map is not None:
                on_map((number + (k + 1) / len(now)) / len(passes))
    return downweight_unconfirmed([_weight_by_score(m, score) for m, score in zip(now, scores)], chosen)


def neighboring_maps(maps: Sequence[DepthMap], k: int) -> list[int]:
    """Indices of the maps to compare map k with: same place, seen from an angle near ``BEST_DEG``."""
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


def downweight_unconfirmed(maps: Sequence[DepthMap], chosen: Sequence[Sequence[int]]) -> list[DepthMap]:
    """Scale by ``ALONE`` the trust of pixels that no map in ``chosen`` for their map confirms."""
    out = []
    for k, found in enumerate(maps):
        points = found.points()
        agree = np.zeros(len(points), np.bool_)
        for j in chosen[k]:
            agree |= on_surface(maps[j], points, CONFIRMED)
        alone = np.zeros(found.depth.shape, np.bool_)
        alone[found.seen] = ~agree
        out.append(replace(found, trust=np.where(alone, np.float32(ALONE) * found.trust, found.trust)))
    return out


def on_surface(found: DepthMap, points: NDArray[np.float64], within: float) -> NDArray[np.bool_]:
    """Whether each point (N, 3) lies on a depth map's surface. within: tolerance, share of the distance."""
    lens, pose = found.intrinsics, found.camera_to_world
    local = (points - pose[:3, 3]) @ pose[:3, :3]
    with np.errstate(invalid="ignore"):
        at = lens.project(local)
        inside = np.all((at >= 0) & (at < (lens.width, lens.height)), axis=1)
    column, row = np.where(inside[:, None], at, 0.0).astype(np.int64).T
    distance = np.linalg.norm(local, axis=1)
    shown = np.where(found.seen, found.depth, 0.0)[row, column]
    # The nearest pixel's ray may hit a steep surface a pixel's width nearer or farther.
    tolerance = (within + 1.0 / min(lens.fx, lens.fy)) * distance
    agree: NDArray[np.bool_] = inside & (np.abs(shown - distance) <= tolerance)
    return agree


def _grey(picture: NDArray[np.uint8], found: DepthMap) -> NDArray[np.float32]:
    if picture.shape[:2] != found.depth.shape:
        raise SurfaceError(f"a picture of {picture.shape} does not belong to a depth map {found.depth.shape}")
    return cv2.cvtColor(np.ascontiguousarray(picture[..., :3]), cv2.COLOR_RGB2GRAY).astype(np.float32)


def _sweep_map(
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
    others = SourceImages(
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
    """Unit normals float32 (H, W, 3) in world axes, from derivatives of the smoothed known points: the plane
    that best fits the pixels around each."""
    seen = found.seen
    points = np.where(seen[..., None], rays * found.depth[..., None], 0.0)
    weight = cv2.GaussianBlur(seen.astype(np.float64), (0, 0), SMOOTH_PX)
    smooth = cv2.GaussianBlur(points, (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6)[..., None]
    normal = np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1.0), -rays)
    return normal.astype(np.float32)


def _filter_depth(
    depth: NDArray[np.float32], seen: NDArray[np.bool_], score: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Initial depth of the next pass: the 5 x 5 median, without outliers, where images agree; elsewhere
    interpolated from nearby pixels where they agree."""
    known = cv2.erode(seen.astype(np.uint8), np.ones((5, 5), np.uint8)).astype(bool)
    calm = np.where(known, cv2.medianBlur(depth, 5), depth)
    good = (seen & (score >= AGREES)).astype(np.float32)
    weight = cv2.GaussianBlur(good, (0, 0), SMOOTH_PX)
    between = cv2.GaussianBlur(good * calm, (0, 0), SMOOTH_PX) / np.maximum(weight, 1e-6)
    lost = seen & (good == 0) & (weight > ENOUGH)
    return np.where(lost, between, calm).astype(np.float32)


def _weight_by_score(found: DepthMap, score: NDArray[np.float32]) -> DepthMap:
    """Weight each pixel of a depth map by how well the images agree there."""
    sure = np.clip((score - AGREES) / (1.0 - AGREES), 0.0, 1.0)
    sure = np.where(score == 0.0, np.float32(UNSURE), sure)
    depth = np.where(found.seen & (sure <= 0.0), np.float32(0.0), found.depth)
    return depth_map(depth, found.color, found.camera_to_world, found.intrinsics, sure)
