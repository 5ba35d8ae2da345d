"""How much each pixel of each view counts, and which views are refused as outliers.

Every representation multiplies a pixel's loss by its weight, the product of three factors:
``View.weight`` (what a policy's treatment made of a stale view), ``age_tau_ms`` (older views count less) and
``mask_stale_ms`` (an old view does not teach what was moving when it was taken). The two options are off by
default. ``find_outliers`` is for pictures that cannot be of this scene at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.supervision import CameraMemory
from edge_server.fields.common.trainer_settings import FieldSettings

LEAST_VIEWS = 4  # views a set needs before the others can outvote one
GRID = 8  # pixels a side of the grid that a view is judged by
LEAST_ERROR = 0.1  # no view is refused for less, in [0, 1]: a well-learned scene has small usual errors
AGREEMENT = 1.5  # times the usual error up to which a view agrees with the field
MOST_REFUSALS = 20  # views of a camera refused in a row

# (views, image points (N, 2) of each) -> the colors (N, 3) that a field renders there, of each.
RenderPoints = Callable[[Sequence[View], Sequence[NDArray[np.float64]]], Sequence[NDArray[np.float32]]]


def pixel_weights(
    views: Sequence[View], memory: Mapping[str, CameraMemory], settings: FieldSettings
) -> list[NDArray[np.float32]] | None:
    """A weight in [0, 1] for each pixel of each view, float32 (H, W); None: all pixels count in full.

    An age is the difference of ``shows_ns`` to the newest view of the set. The newest view therefore counts
    in full, and a view that was carried forward to the present has no age. What moved is known only of
    cameras that stood still between their last two views. Other views are not masked but weighted by age
    alone: a field of few views loses more with a whole view than through what moved in it.
    """
    tau_ms, stale_ms = settings.age_tau_ms, settings.mask_stale_ms
    if not views or (tau_ms <= 0.0 and stale_ms <= 0.0 and all(view.weight is None for view in views)):
        return None
    newest_ns = max(view.shows_ns for view in views)
    result, all_ones = [], True
    for view in views:
        age_ms = (newest_ns - view.shows_ns) / 1e6
        by_age = np.exp(-age_ms / tau_ms) if tau_ms > 0.0 else 1.0
        weight = np.full(view.image.shape[:2], by_age, np.float32)
        known = memory.get(view.camera)
        moved = known.moved if known is not None and known.view is view else None
        if moved is not None and 0.0 < stale_ms < age_ms:
            weight[_dilated(moved, settings.mask_grow_px_s * age_ms / 1e3)] = 0.0
        if view.weight is not None:
            weight *= view.weight
        all_ones = all_ones and bool((weight == 1.0).all())
        result.append(weight)
    return None if all_ones else result


def find_outliers(
    views: Sequence[View], memory: Mapping[str, CameraMemory], beyond: float, settled: bool, render_points: RenderPoints
) -> NDArray[np.bool_]:
    """Which views contradict the field so much that this fit leaves them out (``refuse``): bool (V,).

    views: the views of this fit; each has an entry in ``memory``.
    memory: camera -> its newest view; ``refusals_left`` of the entries is updated.
    beyond: multiple of the usual error above which a view contradicts; 0: no view is refused.
    settled: whether the field has learned enough to be compared with.
    render_points: renders the field at image points.
    """
    if beyond <= 0.0 or not settled or len(views) < LEAST_VIEWS:
        return np.zeros(len(views), np.bool_)
    rendered = render_points(views, [_grid_points(view) for view in views])
    errors = np.array([_typical_error(view, colors) for view, colors in zip(views, rendered)])
    usual = usual_error(errors, beyond)
    few = 4 * (errors > beyond * usual).sum() <= len(views)
    return np.array([refuse(memory[v.camera], e, usual, beyond, few) for v, e in zip(views, errors)], np.bool_)


def refuse(camera: CameraMemory, error: float, usual: float, beyond: float, few: bool) -> bool:
    """Whether a view is refused because it contradicts the field.

    A view contradicts the field when half of it is off by more than ``beyond`` times what is usual for the
    set: an image of noise, of another scene, of nothing. What moves through an image does not reach that. A
    view is refused only where an earlier one from the same place agreed (a camera that sees what no other
    does is learned from), only ``MOST_REFUSALS`` times in a row (then the scene must have changed), and never
    together with more than a quarter of the views.

    camera: its ``refusals_left`` is updated.
    error: median error of the view, in [0, 1]. usual: ``usual_error`` of the set.
    few: whether at most a quarter of the views contradict the field.
    """
    if error <= AGREEMENT * usual:
        camera.refusals_left = MOST_REFUSALS
    elif error > beyond * usual and few and camera.refusals_left > 0:
        camera.refusals_left -= 1
        return True
    return False


def usual_error(errors: Sequence[float] | NDArray[np.float64], beyond: float) -> float:
    """The error that is usual for a set of views, from that of each view."""
    # The lower bound matters where half of every image is plain sky, rendered exactly: no other view would
    # agree.
    return max(float(np.median(errors)), LEAST_ERROR / beyond)


def _grid_points(view: View) -> NDArray[np.float64]:
    """The centers (N, 2) of the pixels that a view is judged by."""
    height, width = view.image.shape[:2]
    middle = (np.arange(GRID) + 0.5) / GRID
    column, row = np.meshgrid(np.floor(middle * width), np.floor(middle * height))
    return np.stack([column.ravel() + 0.5, row.ravel() + 0.5], axis=-1)


def _typical_error(view: View, rendered: NDArray[np.float32]) -> float:
    """The median over the grid of the error of the worst channel, in [0, 1]. rendered: (N, 3)."""
    column, row = _grid_points(view).astype(np.int64).T
    taken = view.image[row, column].astype(np.float32) / 255.0
    off = np.abs(rendered - taken[:, :3]).max(axis=1)
    if taken.shape[1] == 4:
        off *= taken[:, 3]  # transparent pixels are not judged
    return float(np.median(np.nan_to_num(off, nan=1.0)))


def _dilated(mask: NDArray[np.bool_], by_px: float) -> NDArray[np.bool_]:
    """The mask grown by so many pixels to each side: what moved has moved on since."""
    margin = int(min(round(by_px), max(mask.shape)))
    if margin < 1:
        return mask
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
