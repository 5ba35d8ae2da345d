"""Where surfaces are likely before anything is known, asked of whole pictures (``kernels.plane_sweep``):
for the first Gaussians of ``splat``, and to guide fields that would have to find depth by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.kernels.plane_sweep import (
    MOST_VIEWS,
    NOT_SEEN,
    SEES,
    UNMARKED,
    score_cells,
    sweep_rays,
)
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.kernels.thread_pool import Pool
from edge_server.fields.common.scene_box import SceneBox, plain_background
from edge_server.fields.common.supervision import asked_views, pack_cameras
from edge_server.fields.splat.buffers import camera_rows

TOLERANCE = 0.08  # summed over the channels: more and walls are taken to be where they are not
GUIDE_CELLS = 96  # a side: finer ones are hardly better a guide, and cost their cube
GUIDE_RAYS = 1 << 16  # swept at most; the pixels between two share what is found
AGREED = 0.3  # of the scores of ``score_cells``: half of the cameras that see a place, and three at least
LEAST_VIEWS = 3  # that see a place: two agree on a colour all too often
_PLAIN, _CLEAR = 0.06, 16  # of a colour, summed over channels; of alpha: below, a pixel shows nothing


class SweepSettings(Protocol):
    """The options that are read here."""

    @property
    def background(self) -> str: ...
    @property
    def min_views(self) -> int: ...


def empty_color(settings: SweepSettings, views: Sequence[View]) -> NDArray[np.float32] | None:
    """The plain colour (3,) that is rendered where nothing is, if pictures have one: with a background of
    the user's choice, a plain sky has to be made of something like everything else."""
    return plain_background(views) if settings.background == "auto" and views else None


def shows(image: NDArray[np.uint8], plain: NDArray[np.float32] | None) -> NDArray[np.bool_]:
    """Which pixels (H, W) show something: neither transparent nor of the plain colour (3,) behind all."""
    if image.shape[2] == 4:
        return np.asarray(image[..., 3] >= _CLEAR)
    if plain is None:
        return np.ones(image.shape[:2], bool)
    return np.asarray(np.abs(image / 255.0 - plain).sum(axis=2) >= _PLAIN)


def score(
    settings: SweepSettings, pool: Pool, box: SceneBox, views: Sequence[View],
    moved: Sequence[NDArray[np.bool_] | None] | None, all_data: Views, cells: int, least: int = 0,
) -> NDArray[np.float32]:  # fmt: skip
    """How well the cameras agree on a colour, float32 (cells^3,): see ``kernels.plane_sweep.score_cells``.
    moved: bool (H, W) of each view; None: all places are looked at, else those that most cameras see move.
    least: cameras that have to see a place, if ``min_views`` does not ask for more."""
    asked = asked_views(all_data)
    chosen = [asked[k] for k in np.unique(np.linspace(0, len(asked) - 1, MOST_VIEWS).astype(int))]
    some = [views[k] for k in chosen]
    cams = camera_rows([v.camera_to_world for v in some], [v.intrinsics for v in some], box)
    data = pack_cameras(some, box)
    if all_data.weight.size:
        weight = [all_data.weight[all_data.first[k] : all_data.first[k + 1]] for k in chosen]
        data = data._replace(weight=np.concatenate(weight))
    channels = max(v.image.shape[2] for v in some)
    blurred = np.full((int(data.first[-1]), channels), 255, np.uint8)
    says = np.zeros(0 if moved is None else len(blurred) + 1, np.int32)
    for k, view in enumerate(some):
        footprint = (4.0 if box.contracted else 2.0) * box.radius_m / cells / box.distance_m
        size = 2 * (max(int(0.5 * footprint * view.intrinsics.fx), 1) // 2) + 1
        a, b = data.first[k], data.first[k + 1]
        image = cv2.blur(view.image, (size, size)) if size > 1 else view.image
        blurred[a:b, : image.shape[2]] = image.reshape(int(b - a), -1)
        if moved is None:
            continue
        says[a:b] = SEES + UNMARKED
        mask = moved[chosen[k]]
        if mask is not None:  # a cell is as wide as so many pixels
            wide = cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8))
            says[a:b][wide.reshape(-1) > 0] = SEES
        if data.weight.size:
            says[a:b][data.weight[a:b] <= 0] = 0
    plain = empty_color(settings, some)
    needed = min(max(settings.min_views, least), len(some))
    scores = np.zeros(cells**3, np.float32)
    pool.run(
        score_cells, cams, data, blurred, says, plain is not None,
        plain if plain is not None else np.zeros(3, np.float32), np.float32(TOLERANCE), box.contracted, cells,
        needed, scores,
    )  # fmt: skip
    return scores


def sweep(
    pool: Pool, box: SceneBox, data: Views, view_of: NDArray[np.int64], pixels: NDArray[np.int64],
    scores: NDArray[np.float32], cells: int, least: float = NOT_SEEN,
) -> NDArray[np.float32]:  # fmt: skip
    """The distance in scene units of the best cell on each ray, float32 (N,); 0: none is better than
    ``least``. view_of, pixels: int64 (N,), a ray's view and its pixel there."""
    distance = np.zeros(pixels.size, np.float32)
    near, middle = np.float32(max(0.01, box.near_m / box.radius_m)), np.float32(box.distance_m / box.radius_m)
    pool.run(
        sweep_rays, data, view_of, pixels, near, middle, box.contracted, cells, np.float32(least), scores,
        distance,
    )  # fmt: skip
    return distance


def guide(
    settings: SweepSettings, pool: Pool, box: SceneBox, views: Sequence[View], data: Views
) -> NDArray[np.float32]:
    """Distances in scene units at which pixels show something, as far as colours tell: float32 (N,) of all
    pixels of ``data``, 0 where they do not; (0,) where too few views are to be learnt from."""
    if len(asked_views(data)) < LEAST_VIEWS:
        return np.zeros(0, np.float32)
    scores = score(settings, pool, box, views, None, data, GUIDE_CELLS, LEAST_VIEWS)
    plain = empty_color(settings, [views[k] for k in asked_views(data)])
    # A pixel of each square speaks for all of it.
    side = max(int(np.ceil(np.sqrt(data.first[-1] / GUIDE_RAYS))), 1)
    middles = [_middles(v.image.shape[0], v.image.shape[1], side) for v in views]
    of = np.repeat(np.arange(len(views)), [m.size for m in middles])
    found = sweep(
        pool, box, data, of, np.concatenate([m.reshape(-1) for m in middles]), scores, GUIDE_CELLS, AGREED
    )
    out = []
    for k, (view, m) in enumerate(zip(views, middles)):
        height, width = view.image.shape[:2]
        squares = found[of == k].reshape(m.shape)
        wide = squares.repeat(side, axis=0)[:height].repeat(side, axis=1)[:, :width]
        out.append(np.where(shows(view.image, plain), wide, np.float32(0.0)).reshape(-1))
    return np.concatenate(out)


def _middles(height: int, width: int, side: int) -> NDArray[np.int64]:
    """The pixel in the middle of each square of a picture, (squares down, squares across)."""
    y, x = (np.minimum(np.arange(side // 2, n + side, side), n - 1)[: -(-n // side)] for n in (height, width))
    return np.asarray(y[:, None] * width + x, dtype=np.int64)
