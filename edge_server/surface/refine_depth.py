"""Refine depth maps by photo-consistency before fusion.

A field is fitted to colors, so its depth may be off by many pixels where a surface has little texture, and it
closes narrow gaps. Here the images decide: every pixel gets the plane on which other images agree best with
its own (multi-view PatchMatch, ``kernels.patch_match``). The first passes search ``REACH`` of the depth to
each side of the field's, the last ones also ask that the depth of one image leads to that of the others
(geometric consistency as in ACMM, Xu and Tao 2019). Pixels whose depth no other map confirms are dropped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool, shared_pool
from edge_server.surface import SurfaceError
from edge_server.surface import settings as tuned
from edge_server.surface.depth import DepthMap
from edge_server.surface.kernels.patch_images import Images, Planes, Search, View
from edge_server.surface.kernels.patch_match import SOURCES, WORST, choose_sources, confirm, match, offer
from freshfield.geometry import seen_from


@dataclass(frozen=True)
class Phase:
    """One pass over every map.

    choose: whether the images to compare with are chosen anew, from the current planes.
    offer: which of the other maps' points that fall on a pixel offers its plane: the "cheapest" or the
    "nearest"; "": none.
    """

    search: Search
    choose: bool = False
    offer: str = ""


PHASES = (
    Phase(Search(4, tuned.REACH, 0.02, 0.4, 0.0), choose=True),
    Phase(Search(4, tuned.REACH, 0.02, 0.4, 0.0)),
    Phase(Search(4, tuned.REACH, 0.01, 0.3, 0.0), choose=True, offer="cheapest"),
    Phase(Search(2, tuned.REACH, 0.005, 0.2, 0.0), offer="nearest"),
    Phase(Search(0, tuned.REACH, 0.005, 0.2, 0.1), choose=True, offer="cheapest"),
    Phase(Search(0, tuned.REACH, 0.002, 0.1, 0.1), choose=True, offer="nearest"),
)


def refine_depth(
    maps: Sequence[DepthMap],
    photos: Sequence[NDArray[np.uint8]],
    pool: Pool | None = None,
    on_map: Callable[[float], None] | None = None,
) -> list[DepthMap]:
    """Refine the depth of ``maps``. photos: camera images, uint8 (H, W, 3 or 4) each. on_map: called with
    the completed share. SurfaceError: the images do not match the maps."""
    if len(maps) != len(photos):
        raise SurfaceError(f"{len(photos)} images do not belong to {len(maps)} depth maps")
    pool = pool or shared_pool()
    grays = [_gray(photo, found) for photo, found in zip(photos, maps)]
    gains = exposures(maps, grays)
    grays = [(gray / np.float32(gain)).astype(np.float32) for gray, gain in zip(grays, gains)]
    guesses = [_fill_unknown(found) for found in maps]
    views = [_view(k, found, gray) for k, (found, gray) in enumerate(zip(maps, grays))]
    planes = [
        Planes(guess.copy(), smooth_normals(guess, view.rays), np.full(guess.shape, WORST, np.float32))
        for guess, view in zip(guesses, views)
    ]
    for number, phase in enumerate(PHASES):
        # Every map is compared with the others as they were before the phase, whatever the order.
        images = _images(maps, grays, planes)
        offers = _offers(images, views, planes, phase.offer, pool)
        for k, (view, guess, found, offered) in enumerate(zip(views, guesses, planes, offers)):
            if phase.choose:
                pool.run(choose_sources, images, view, found, number > 0)
            for parity in (0, 1):
                key = np.uint64((len(PHASES) * k + number) * 2 + parity)
                pool.run(match, images, view, guess, offered, found, parity, key, phase.search)
            if on_map is not None:
                on_map((number + (k + 1) / len(maps)) / (len(PHASES) + 1))
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


def _gray(photo: NDArray[np.uint8], found: DepthMap) -> NDArray[np.float32]:
    """Gray levels, not rounded: a third of the noise where only shading varies."""
    if photo.shape[:2] != found.depth.shape:
        raise SurfaceError(f"an image of {photo.shape} does not belong to a depth map {found.depth.shape}")
    color = np.ascontiguousarray(photo[..., :3]).astype(np.float32)
    return cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)


def _fill_unknown(found: DepthMap) -> NDArray[np.float32]:
    """Initial depth: unknown pixels take that of the nearest known one; 0 where the ray hits nothing."""
    depth = np.where(found.seen, found.depth, np.float32(0.0))
    if not found.seen.any():
        return depth
    _, label = cv2.distanceTransformWithLabels(
        (~found.seen).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(int(label.max()) + 1, np.float32)
    of_label[label[found.seen]] = depth[found.seen]
    return np.where(found.depth == 0, of_label[label], depth)


def _view(k: int, found: DepthMap, gray: NDArray[np.float32]) -> View:
    rays = np.ascontiguousarray(found.intrinsics.rays() @ found.camera_to_world[:3, :3].T)
    return View(k, rays, gray, np.full((*gray.shape, SOURCES), -1, np.int16))


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


def _offers(images: Images, views: Sequence[View], planes: Sequence[Planes], which: str, pool: Pool) -> list[Planes]:
    """For every map, planes of other maps to try, see ``Phase``."""
    none = [Planes(np.zeros_like(p.depth), p.normal, p.cost) for p in planes]
    sure = [(p.depth > 0) & (p.cost < tuned.OFFERED) for p in planes]
    if not which or not any(s.any() for s in sure):
        return none
    points = np.concatenate(
        [
            (images.origin[v.index] + v.rays[s] * p.depth[s, None]).astype(np.float32)
            for v, p, s in zip(views, planes, sure)
        ]
    )
    normals = np.concatenate([p.normal[s] for p, s in zip(planes, sure)])
    costs = np.concatenate([p.cost[s] for p, s in zip(planes, sure)])
    owners = np.repeat(np.arange(len(planes), dtype=np.int32), [int(s.sum()) for s in sure])
    winner, least = np.empty(len(images.gray), np.int32), np.empty(len(images.gray), np.float32)
    pool.run(offer, images, points, normals, costs, owners, which == "nearest", winner, least)
    out = []
    for view, empty, first in zip(views, none, images.first):
        won = winner[first : first + view.gray.size].reshape(view.gray.shape)
        some = won >= 0
        index, ray = won[some], view.rays[some]
        along = (normals[index] * ray).sum(axis=-1)
        reach = (normals[index] * (points[index] - images.origin[view.index])).sum(axis=-1)
        depth, normal = empty.depth, empty.normal.copy()
        depth[some] = np.where(along < -1e-3, reach / np.minimum(along, -1e-3), 0.0)
        normal[some] = normals[index]
        out.append(Planes(depth, normal, empty.cost))
    return out


def _with_trust(found: DepthMap, view: View, planes: Planes, images: Images, pool: Pool) -> DepthMap:
    """The map with the depth of ``planes``, each trusted by its cost and by the maps that confirm it."""
    shape = planes.depth.shape
    agree, against = np.zeros(shape, np.int16), np.zeros(shape, np.int16)
    rise = np.zeros(shape, np.float32)
    pool.run(confirm, images, view, planes, tuned.CONFIRMED, agree, against, rise)
    compared = view.chosen[..., 0] >= 0
    alike = np.clip((tuned.DEAR - planes.cost) / (tuned.DEAR - tuned.CHEAP), 0.0, 1.0)
    sure = alike * np.minimum(0.4 + 0.2 * agree, 1.0) * ((agree > 0) & (agree >= against))
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
