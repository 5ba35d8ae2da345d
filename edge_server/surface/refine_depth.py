"""Refine depth maps by photo-consistency before fusion.

A field is fitted to colors, so its depth may be off by many pixels where a surface has little texture, and it
closes narrow gaps. Here the images decide: every pixel gets the plane on which other images agree best with
its own (multi-view PatchMatch, ``kernels.patch_match``). The first passes search ``REACH`` of the depth to
each side of the field's, the last ones also ask that the depth of one image leads to that of the others
(geometric consistency as in ACMM, Xu and Tao 2019). Pixels whose depth no other map confirms are dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool, shared_pool
from edge_server.fields.splat.carried_camera.seeds_on_depth import filled
from edge_server.surface import surface_constants as tuned
from edge_server.surface.depth import DepthMap
from edge_server.surface.kernels.patch_images import Images, Planes, Search, View
from edge_server.surface.kernels.patch_match import choose_sources, confirm, match
from freshfield.geometry import seen_from

PASSES = tuple(
    Search(choose, wide, tuned.REACH, share, turn, geometric) for choose, wide, share, turn, geometric in tuned.SEARCHES
)


def refine_depth(
    maps: Sequence[DepthMap],
    photos: Sequence[NDArray[np.uint8]],
    pool: Pool | None = None,
    on_map: Callable[[float], None] | None = None,
) -> list[DepthMap]:
    """Refine the depth of ``maps``. photos: camera images, uint8 (H, W, 3 or 4) each. on_map: called with
    the completed share."""
    pool = pool or shared_pool()
    grays = [_gray(photo) for photo in photos]
    gains = exposures(maps, grays)
    grays = [(gray / np.float32(gain)).astype(np.float32) for gray, gain in zip(grays, gains)]
    guesses = [_fill_unknown(found) for found in maps]
    views = [_view(k, found, gray) for k, (found, gray) in enumerate(zip(maps, grays))]
    planes = [
        Planes(guess.copy(), smooth_normals(guess, view.rays), np.full(guess.shape, tuned.WORST, np.float32))
        for guess, view in zip(guesses, views)
    ]
    for number, search in enumerate(PASSES):
        # Every map is compared with the others as they were before the pass, whatever the order.
        images = _images(maps, grays, planes)
        for k, (view, guess, found) in enumerate(zip(views, guesses, planes)):
            if search.choose:
                pool.run(choose_sources, images, view, found)
            for parity in (0, 1):
                key = np.uint64((len(PASSES) * k + number) * 2 + parity)
                pool.run(match, images, view, guess, found, parity, key, search)
            if on_map is not None:
                on_map((number + (k + 1) / len(maps)) / (len(PASSES) + 1))
    images = _images(maps, grays, planes)
    out = [_with_trust(*each, images, pool) for each in zip(maps, views, planes)]
    if on_map is not None:
        on_map(1.0)
    return out


def exposures(maps: Sequence[DepthMap], grays: Sequence[NDArray[np.float32]]) -> NDArray[np.float64]:
    """Brightness of each image relative to the others (N,), from points that two of them show: least squares
    over the medians of all pairs. 1 where it is within ``SAME_GAIN``, or unknown."""
    pairs, ratios = [], []
    for k, found in enumerate(maps):
        at = np.flatnonzero(found.seen)
        at = at[:: max(1, len(at) // tuned.GAIN_POINTS)]
        points = found.points()[:: max(1, int(found.seen.sum()) // tuned.GAIN_POINTS)]
        own = grays[k].ravel()[at]
        for j, other in enumerate(maps):
            both = on_surface(other, points, tuned.GAIN_WITHIN) if j != k else np.zeros(0, np.bool_)
            if both.sum() < tuned.LEAST_SHARED:
                continue
            _, at_other, _ = seen_from(other.intrinsics, other.camera_to_world, points[both])
            column, row = at_other.astype(np.int64).T
            pairs.append((k, j))
            ratios.append(np.median(np.log((grays[j][row, column] + 1.0) / (own[both] + 1.0))))
    system = np.eye(len(maps)) * 1e-3  # images that share nothing keep their brightness
    right = np.zeros(len(maps))
    for (k, j), ratio in zip(pairs, ratios):
        system[[k, j], [k, j]] += 1.0
        system[[k, j], [j, k]] -= 1.0
        right[j] += ratio
        right[k] -= ratio
    log_gain = np.linalg.solve(system, right) if len(maps) else right
    return np.where(
        np.abs(log_gain) > tuned.SAME_GAIN, np.exp(np.clip(log_gain, -tuned.MOST_GAIN, tuned.MOST_GAIN)), 1.0
    )


def on_surface(found: DepthMap, points: NDArray[np.float64], within: float) -> NDArray[np.bool_]:
    """Whether each point (N, 3) lies on a depth map's surface. within: tolerance, share of the distance."""
    lens, pose = found.intrinsics, found.camera_to_world
    local, at, inside = seen_from(lens, pose, points)
    column, row = np.where(inside[:, None], at, 0.0).astype(np.int64).T
    distance = np.linalg.norm(local, axis=1)
    shown = found.depth[row, column]  # 0: unknown, infinite: nothing is there
    # The nearest pixel's ray may hit a steep surface a pixel's width nearer or farther.
    tolerance = (within + 1.0 / min(lens.fx, lens.fy)) * distance
    agree: NDArray[np.bool_] = inside & (np.abs(shown - distance) <= tolerance)
    return agree


def smooth_normals(depth: NDArray[np.float32], rays: NDArray[np.float64]) -> NDArray[np.float32]:
    """Unit normals float32 (H, W, 3) in world axes, towards the camera, from derivatives of the smoothed
    known points: the plane that best fits the pixels around each."""
    known = depth > 0
    points = rays * depth[..., None].astype(np.float64)
    weight = cv2.GaussianBlur(known.astype(np.float64), (0, 0), tuned.SMOOTH_PX)
    smooth = cv2.GaussianBlur(points, (0, 0), tuned.SMOOTH_PX) / np.maximum(weight, 1e-6)[..., None]
    normal = np.cross(np.gradient(smooth, axis=1), np.gradient(smooth, axis=0))
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(length > 0, normal / np.where(length > 0, length, 1.0), -rays)
    away = (normal * rays).sum(axis=-1, keepdims=True) > 0
    return np.where(away, -normal, normal).astype(np.float32)


def _gray(photo: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Gray levels, not rounded: a third of the noise where only shading varies."""
    color = np.ascontiguousarray(photo[..., :3]).astype(np.float32)
    return cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _fill_unknown(found: DepthMap) -> NDArray[np.float32]:
    """Initial depth: unknown pixels take that of the nearest known one; 0 where the ray hits nothing."""
    depth = np.where(found.seen, found.depth, np.float32(0.0))
    return np.where(found.depth == 0, filled(depth), depth)


def _view(k: int, found: DepthMap, gray: NDArray[np.float32]) -> View:
    rays = np.ascontiguousarray(found.intrinsics.rays() @ found.camera_to_world[:3, :3].T)
    return View(k, rays, gray, np.full((*gray.shape, tuned.SOURCES), -1, np.int16))


def _images(maps: Sequence[DepthMap], grays: Sequence[NDArray[np.float32]], planes: Sequence[Planes]) -> Images:
    size = np.array([[m.intrinsics.width, m.intrinsics.height] for m in maps], np.int64).reshape(-1, 2)
    return Images(
        lens=np.array([lens_row(m.intrinsics) for m in maps], dtype=np.float64).reshape(-1, 8),
        rotation=np.array([m.camera_to_world[:3, :3] for m in maps]).reshape(-1, 3, 3),
        origin=np.array([m.camera_to_world[:3, 3] for m in maps]).reshape(-1, 3),
        first=np.concatenate([[0], np.cumsum(size[:, 0] * size[:, 1])]).astype(np.int64),
        size=size,
        gray=np.concatenate([gray.ravel() for gray in grays]),
        depth=np.concatenate([found.depth.ravel() for found in planes]),
    )


def _with_trust(found: DepthMap, view: View, planes: Planes, images: Images, pool: Pool) -> DepthMap:
    """The map with the depth of ``planes``, each trusted by its cost and by the maps that confirm it."""
    shape = planes.depth.shape
    agree, against = np.zeros(shape, np.int16), np.zeros(shape, np.int16)
    rise = np.zeros(shape, np.float32)
    pool.run(confirm, images, view, planes, tuned.CONFIRMED, agree, against, rise)
    compared = view.chosen[..., 0] >= 0
    alike = np.clip((tuned.DEAR - planes.cost) / (tuned.DEAR - tuned.CHEAP), 0.0, 1.0)
    confirmed = np.minimum(tuned.CONFIRMED_FIRST + tuned.CONFIRMED_EACH * agree, 1.0)
    sure = alike * confirmed * ((agree > 0) & (agree >= against))
    # Images may agree by being flat; then only the field knows.
    sure = np.where(rise >= tuned.PLAIN, sure, np.minimum(sure, tuned.UNSURE))
    # What no other camera sees, and what they show flat, stays as the field has it.
    compared &= np.abs(rise) > tuned.NOTHING
    kept = np.where(compared, sure > 0.0, found.seen)
    depth = np.where(compared, planes.depth, np.where(found.seen, found.depth, np.float32(0.0)))
    cosine = -(planes.normal * view.rays).sum(axis=-1)
    cosine = np.where(compared, np.maximum(cosine, 0.0), found.cosine)
    empty = np.isposinf(found.depth)
    trust = np.where(compared, sure, np.float32(tuned.UNSURE)) * cosine
    return replace(
        found,
        depth=np.where(kept, depth, np.where(empty, np.inf, 0.0)).astype(np.float32),
        trust=np.where(kept, trust, np.where(empty, found.trust, 0.0)).astype(np.float32),
        cosine=np.where(empty, found.cosine, cosine).astype(np.float32),
    )
