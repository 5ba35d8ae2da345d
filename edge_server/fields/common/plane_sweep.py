"""Plane sweep: finds where surfaces are likely from whole pictures, before anything is learned
(``kernels.plane_sweep``). It places the first Gaussians of a splat and guides the depth of other fields."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.background import empty_color, foreground_mask
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.plane_sweep import NOT_SEEN, SEES, UNMARKED, score_cells, sweep_rays
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.settings import FieldSettings
from edge_server.fields.common.supervision import pack_cameras, supervising_views
from edge_server.fields.common.threads.thread_pool import Pool


def score_grid(
    settings: FieldSettings,
    pool: Pool,
    box: SceneBox,
    views: Sequence[View],
    moved: Sequence[NDArray[np.bool_] | None] | None,
    all_data: Views,
    cells: int,
    least: int = 0,
) -> NDArray[np.float32]:
    """How well the cameras agree on the color of each cell, float32 (cells^3,): see ``score_cells``.

    moved: bool (H, W) of each view; only cells that most cameras see move are scored. None: all cells are.
    all_data: the packed views, for their weights. cells: a side.
    least: number of cameras that must see a cell, if ``min_views`` does not ask for more.
    """
    candidates = supervising_views(all_data)
    chosen = [candidates[k] for k in np.unique(np.linspace(0, len(candidates) - 1, tuned.SWEEP_VIEWS).astype(int))]
    some = [views[k] for k in chosen]
    cams = camera_rows([v.camera_to_world for v in some], [v.intrinsics for v in some], box)
    data = pack_cameras(some, box)
    if all_data.weight.size:
        weight = [all_data.weight[all_data.first[k] : all_data.first[k + 1]] for k in chosen]
        data = data._replace(weight=np.concatenate(weight))
    channels = max(v.image.shape[2] for v in some)
    blurred = np.full((int(data.first[-1]), channels), 255, np.uint8)
    flags = np.zeros(0 if moved is None else len(blurred) + 1, np.int32)
    for k, view in enumerate(some):
        footprint = (4.0 if box.contracted else 2.0) * box.radius_m / cells / box.distance_m
        size = 2 * (max(int(0.5 * footprint * view.intrinsics.fx), 1) // 2) + 1
        a, b = data.first[k], data.first[k + 1]
        image = cv2.blur(view.image, (size, size)) if size > 1 else view.image
        blurred[a:b, : image.shape[2]] = image.reshape(int(b - a), -1)
        if moved is None:
            continue
        flags[a:b] = SEES + UNMARKED
        mask = moved[chosen[k]]
        if mask is not None:  # a cell is ``size`` pixels wide
            wide = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))
            flags[a:b][wide.reshape(-1) > 0] = SEES
        if data.weight.size:
            flags[a:b][data.weight[a:b] <= 0] = 0
    plain = empty_color(settings, some)
    plain = np.zeros(0, np.float32) if plain is None else plain
    needed = min(max(settings.min_views, least), len(some))
    scores, tolerance = np.zeros(cells**3, np.float32), np.float32(tuned.SWEEP_TOLERANCE)
    pool.run(score_cells, cams, data, blurred, flags, plain, tolerance, box.contracted, cells, needed, scores)
    return scores


def sweep_depths(
    pool: Pool,
    box: SceneBox,
    data: Views,
    view_of: NDArray[np.int64],
    pixels: NDArray[np.int64],
    scores: NDArray[np.float32],
    cells: int,
    least: float = NOT_SEEN,
) -> NDArray[np.float32]:
    """The distance in scene units of the best cell on each ray, float32 (N,); 0: none scores above ``least``.

    view_of, pixels: int64 (N,), each ray's view and its pixel there.
    scores: float32 (cells^3,), from ``score_grid``.
    """
    distance = np.zeros(pixels.size, np.float32)
    near, middle = np.float32(max(tuned.MIN_NEAR, box.near_m / box.radius_m)), np.float32(box.distance_m / box.radius_m)
    pool.run(
        sweep_rays, data, view_of, pixels, near, middle, box.contracted, cells, np.float32(least), scores, distance
    )
    return distance


def depth_guide(
    settings: FieldSettings, pool: Pool, box: SceneBox, views: Sequence[View], data: Views
) -> NDArray[np.float32]:
    """The probable distance in scene units of what each pixel of ``data`` shows: float32 (N,), 0: unknown;
    (0,) if too few views supervise."""
    if len(supervising_views(data)) < tuned.GUIDE_VIEWS:
        return np.zeros(0, np.float32)
    scores = score_grid(settings, pool, box, views, None, data, tuned.GUIDE_CELLS, tuned.GUIDE_VIEWS)
    plain = empty_color(settings, [views[k] for k in supervising_views(data)])
    # One pixel of each square is swept for all of it.
    side = max(int(np.ceil(np.sqrt(data.first[-1] / tuned.GUIDE_RAYS))), 1)
    middles = [_square_centers(v.image.shape[0], v.image.shape[1], side) for v in views]
    of = np.repeat(np.arange(len(views)), [m.size for m in middles])
    places = np.concatenate([m.reshape(-1) for m in middles])
    found = sweep_depths(pool, box, data, of, places, scores, tuned.GUIDE_CELLS, tuned.GUIDE_SCORE)
    out = []
    for k, (view, m) in enumerate(zip(views, middles)):
        height, width = view.image.shape[:2]
        squares = found[of == k].reshape(m.shape)
        wide = squares.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]
        out.append(np.where(foreground_mask(view.image, plain), wide, np.float32(0.0)).reshape(-1))
    return np.concatenate(out)


def _square_centers(height: int, width: int, side: int) -> NDArray[np.int64]:
    """The middle pixel of each square of a picture, (squares down, squares across)."""
    y, x = (np.minimum(np.arange(side // 2, n + side, side), n - 1)[: -(-n // side)] for n in (height, width))
    return np.asarray(y[:, None] * width + x, dtype=np.int64)
