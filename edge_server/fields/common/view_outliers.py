"""How far each pixel of each view is to be trusted: a stale view is only wrong where something moved.

Every representation multiplies a pixel's loss by these weights. A view may bring its own (``View.weight``:
what a policy's treatment made of a stale view). Two options make others, both off by default: ``age_tau_ms``
trusts a view less the older it is, ``mask_stale_ms`` leaves out of an old view what was moving when it was
taken. They are multiplied. ``refused`` is for pictures that cannot be of this scene at all.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View

JUDGES = 4  # views a set needs before the others can outvote one
RASTER = 8  # pixels a side of the raster that a view is judged by
LEAST_ERROR = 0.1  # nothing is refused for less, in [0, 1]: a well-learnt scene has small usual errors
AGREES = 1.5  # times the usual error with which a view agrees
PATIENCE = 20  # refusals in a row


# What a field shows of each view at image points (N, 2): colours (N, 3).
Pixels = Callable[[Sequence[View], Sequence[NDArray[np.float64]]], Sequence[NDArray[np.float32]]]


class TrustSettings(Protocol):
    """The options that are read here; ``TrainerSettings`` says what they mean."""

    @property
    def age_tau_ms(self) -> float: ...
    @property
    def mask_stale_ms(self) -> float: ...
    @property
    def mask_grow_px_s(self) -> float: ...


class Remembered(Protocol):
    """A camera's newest view and the pixels that moved in it: bool (H, W), None where that is unknown."""

    @property
    def view(self) -> View: ...
    @property
    def moved(self) -> NDArray[np.bool_] | None: ...


class Credited(Protocol):
    """What is known of a camera's credit: ``supervision.CameraMemory``."""

    credit: int


def weights(
    views: Sequence[View], memory: Mapping[str, Remembered], settings: TrustSettings
) -> list[NDArray[np.float32]] | None:
    """A weight in [0, 1] for each pixel of each view, float32 (H, W); None: all of them count in full.

    Ages are differences of ``shows_ns`` to the newest view of the set: that view is always trusted whole, and
    one that was carried forward to the present is not doubted for an age that it no longer has. What moved
    is known of cameras that stood still between their own last two views. Of one that was moving, or that
    has sent a single view, it is unknown: its views are not masked, since a field of few views loses more
    with a whole view than through what moved in it, and are weighed by age alone.
    """
    tau_ms, stale_ms = settings.age_tau_ms, settings.mask_stale_ms
    if not views or (tau_ms <= 0.0 and stale_ms <= 0.0 and all(view.weight is None for view in views)):
        return None
    newest_ns = max(view.shows_ns for view in views)
    result, whole = [], True
    for view in views:
        age_ms = (newest_ns - view.shows_ns) / 1e6
        trust = np.exp(-age_ms / tau_ms) if tau_ms > 0.0 else 1.0
        weight = np.full(view.image.shape[:2], trust, np.float32)
        known = memory.get(view.camera)
        moved = known.moved if known is not None and known.view is view else None
        if moved is not None and 0.0 < stale_ms < age_ms:
            weight[_grown(moved, settings.mask_grow_px_s * age_ms / 1e3)] = 0.0
        if view.weight is not None:
            weight *= view.weight
        whole = whole and bool((weight == 1.0).all())
        result.append(weight)
    return None if whole else result


def refused(
    views: Sequence[View],
    memory: Mapping[str, Credited],
    beyond: float,
    settled: bool,
    pixels: Pixels,
) -> NDArray[np.bool_]:
    """Which views (V,) contradict the field so much that they are to be left out of this fit.

    A view contradicts when half of it is off by more than ``beyond`` times what is usual for the views of
    the set (0: none ever does): a picture of noise, of another scene, of nothing. What moves through a
    picture does not reach that. It is refused only where an earlier view from the same place agreed, so a
    camera that sees what no other does is learnt; only ``PATIENCE`` times, for then the scene must have
    changed; and never more than a quarter of the views. settled: whether the field knows enough to agree
    with. pixels: what it shows. Updates the credits in ``memory``.
    """
    none = np.zeros(len(views), np.bool_)
    if beyond <= 0.0 or not settled or len(views) < JUDGES:
        return none
    shown = pixels(views, [_raster(view) for view in views])
    off = np.array([_typical_error(view, colors) for view, colors in zip(views, shown)])
    # No less than this: where half of every picture is plain sky, shown exactly, no view else would agree.
    usual = max(float(np.median(off)), LEAST_ERROR / beyond)
    contradicts = off > beyond * usual
    few = 4 * contradicts.sum() <= len(views)
    for k, view in enumerate(views):
        known = memory[view.camera]
        if off[k] <= AGREES * usual:
            known.credit = PATIENCE
        elif contradicts[k] and few and known.credit > 0:
            known.credit -= 1
            none[k] = True
    return none


def _raster(view: View) -> NDArray[np.float64]:
    """The centres (N, 2) of the pixels that a view is judged by."""
    height, width = view.image.shape[:2]
    middle = (np.arange(RASTER) + 0.5) / RASTER
    column, row = np.meshgrid(np.floor(middle * width), np.floor(middle * height))
    return np.stack([column.ravel() + 0.5, row.ravel() + 0.5], axis=-1)


def _typical_error(view: View, shown: NDArray[np.float32]) -> float:
    """The median over the raster of how far the field (N, 3) is off in the worst channel, in [0, 1]."""
    column, row = _raster(view).astype(np.int64).T
    taken = view.image[row, column].astype(np.float32) / 255.0
    off = np.abs(shown - taken[:, :3]).max(axis=1)
    if taken.shape[1] == 4:
        off *= taken[:, 3]  # what is cut away is not the field's business
    return float(np.median(np.nan_to_num(off, nan=1.0)))


def _grown(mask: NDArray[np.bool_], by_px: float) -> NDArray[np.bool_]:
    """The mask dilated by so many pixels to each side: what moved has moved on since."""
    margin = int(min(round(by_px), max(mask.shape)))
    if margin < 1:
        return mask
    kernel = np.ones((2 * margin + 1, 2 * margin + 1), np.uint8)
    return cv2.dilate(mask.astype(np.uint8), kernel).astype(bool)
