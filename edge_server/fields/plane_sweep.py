"""Where surfaces are likely before anything is known, asked of whole pictures (``kernels.plane_sweep``):
for the first Gaussians of ``splat``, and to guide fields that would have to find depth by themselves."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.kernels.plane_sweep import (
    MOST_VIEWS,
    NOT_SEEN,
    SEES,
    UNMARKED,
    score_cells,
    sweep_rays,
)
from edge_server.fields.kernels.pool import Pool
from edge_server.fields.kernels.rays import Views
from edge_server.fields.scene_box import SceneBox, plain_background
from edge_server.fields.splat_passes import camera_rows
from edge_server.fields.supervision import asked_views, pack_cameras

TOLERANCE = 0.08  # summed over the channels: more and walls are taken to be where they are not
GUIDE_CELLS = 96  # a side: finer ones are of less than a pixel, and cost their cube
GUIDE_RAYS = 1 << 16  # swept at most; the pixels between two share what is found
AGREED = 0.3  # share of the cameras that have to agree with one on a guide
LEAST_VIEWS = 3  # two agree on a colour wherever their rays meet


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


def score(
    settings: SweepSettings, pool: Pool, box: SceneBox, views: Sequence[View],
    moved: Sequence[NDArray[np.bool_] | None] | None, all_data: Views, cells: int,
) -> NDArray[np.float32]:  # fmt: skip
    """How well the cameras agree on a colour, float32 (cells^3,): see ``kernels.plane_sweep.score_cells``.
    moved: bool (H, W) of each view; None: all places are looked at, else those that most cameras see move."""
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
    needed = min(settings.min_views, len(some))
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
    scores = score(settings, pool, box, views, None, data, GUIDE_CELLS)
    # A pixel of each square speaks for all of it.
    side = max(int(np.ceil(np.sqrt(data.first[-1] / GUIDE_RAYS))), 1)
    rasters = [_raster(v.image.shape[0], v.image.shape[1], side) for v in views]
    of = np.repeat(np.arange(len(views)), [len(middle) for middle, _ in rasters])
    found = sweep(
        pool, box, data, of, np.concatenate([middle for middle, _ in rasters]), scores, GUIDE_CELLS, AGREED
    )
    return np.concatenate([found[of == k][square] for k, (_, square) in enumerate(rasters)])


def _raster(height: int, width: int, side: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The pixel in the middle of each square of a picture, (squares,), and the square of each pixel,
    (height * width,)."""
    y, x = (np.minimum(np.arange(side // 2, n + side, side), n - 1)[: -(-n // side)] for n in (height, width))
    middle = (y[:, None] * width + x).reshape(-1)
    square = (np.arange(height) // side)[:, None] * len(x) + np.arange(width) // side
    return middle.astype(np.int64), square.reshape(-1).astype(np.int64)
