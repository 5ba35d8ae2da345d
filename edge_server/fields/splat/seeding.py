"""First Gaussians without structure from motion: pixels placed where the cameras agree on their color."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.background import empty_color, foreground_mask
from edge_server.fields.common.kernels.plane_sweep import NOT_SEEN
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.plane_sweep import score_grid, sweep_depths
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import pack_cameras, supervising_views
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.optimizer_step import clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE, SH_COLUMNS
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.splat_constants import (
    SEED_CANDIDATES,
    SEED_MOST_SEE,
    SEED_OPACITY,
    SEED_SCALE,
    SEED_VIEWS,
)


def seed_gaussians(
    settings: SplatSettings,
    pool: Pool,
    box: SceneBox,
    views: Sequence[View],
    masks: Sequence[NDArray[np.bool_] | None] | None,
    weight: NDArray[np.float32],
    count: int,
    rng: np.random.Generator,
    moved: Sequence[NDArray[np.bool_] | None] | None = None,
) -> NDArray[np.float32]:
    """Parameters of up to ``count`` new Gaussians, float32 (N, P).

    masks: for each view bool (H, W), the pixels from which Gaussians may start (None: no pixel); None instead
        of the list: all pixels of all views.
    weight: ``Views.weight``; pixels of weight 0 are ignored.
    rng: draws the pixels.
    moved: for each view bool (H, W), or None; if given, only places where most cameras see motion count.
    """
    width = BASE + SH_COLUMNS * settings.sh_degree
    data = pack_cameras(views, box)._replace(weight=weight)
    where = _candidate_pixels(settings, views, data, masks)
    if count <= 0 or where.size == 0:
        return np.zeros((0, width), np.float32)
    drawn = rng.choice(where, min(SEED_CANDIDATES * count, where.size), replace=False)
    view_of = np.searchsorted(data.first, drawn, side="right") - 1
    local = drawn - data.first[view_of]
    cells = settings.seed_cells
    scores = score_grid(settings, pool, box, views, moved, data, cells)
    if moved is None and (scores <= NOT_SEEN).all():  # cameras that see nothing in common
        scores = score_grid(replace(settings, min_views=1), pool, box, views, moved, data, cells)
    distance = sweep_depths(pool, box, data, view_of, local, scores, cells)
    found = np.flatnonzero(distance > 0)[:count]
    params = np.zeros((found.size, width), np.float32)
    if found.size == 0:
        return params
    focal = data.lens[:, 0]
    # Several views see each place: the spacing is that of the rays of all views together.
    see = min(max(len(views) / SEED_VIEWS, 1.0), SEED_MOST_SEE)
    spacing = np.sqrt(where.size / found.size / see)
    view_of, local, distance = view_of[found], local[found], distance[found]
    for v in np.unique(view_of):
        mine, lens = np.flatnonzero(view_of == v), views[v].intrinsics
        x, y = local[mine] % lens.width, local[mine] // lens.width
        rays = lens.rays(np.stack([x + 0.5, y + 0.5], axis=-1)) @ data.rotation[v].T
        params[mine, :3] = data.origin[v] + rays * distance[mine, None]
        params[mine, COLOR : COLOR + 3] = views[v].image[y, x, :3] / 255.0
        size = SEED_SCALE * spacing * distance[mine] / focal[v]
        params[mine, SCALE : SCALE + 3] = np.log(size)[:, None]
    params[:, QUATERNION] = 1.0
    params[:, OPACITY] = np.log(SEED_OPACITY / (1.0 - SEED_OPACITY))
    clamp_gaussians(params)
    return params


def _candidate_pixels(
    settings: SplatSettings, views: Sequence[View], data: Views, masks: Sequence[NDArray[np.bool_] | None] | None
) -> NDArray[np.int64]:
    """Indices, over all views, of the pixels that do not show uniform background."""
    plain = empty_color(settings, [views[k] for k in supervising_views(data)])
    parts = [np.zeros(0, np.int64)]
    for k, view in enumerate(views):
        there = foreground_mask(view.image, plain)
        if masks is not None:
            mask = masks[k]
            there = there & mask if mask is not None else np.zeros_like(there)
        if data.weight.size:
            there = there & (data.weight[data.first[k] : data.first[k + 1]] > 0).reshape(there.shape)
        parts.append(data.first[k] + np.flatnonzero(there))
    return np.concatenate(parts).astype(np.int64)
