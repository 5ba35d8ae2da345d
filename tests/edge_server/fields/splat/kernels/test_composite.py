"""A tile's strips: strip_pairs reaches them, where it gets dark, and rows that no projection would write."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.splat.kernels.composite import (
    PIXELS,
    SAVED,
    STOP,
    STRIP,
    STRIPS,
    SUMS,
    bin_strips,
    composite,
    composite_backward,
)
from edge_server.fields.splat.kernels.project import (
    ALPHA,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    MEAN_X,
    MEAN_Y,
    OPACITY,
    PROJECTED,
    QUATERNION,
    RED,
    SCALE,
    TILE,
)
from edge_server.fields.splat.settings import ALPHA_MIN
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, binned

LENS = Pinhole(48, 40, 50.0, 50.0, 24.0, 20.0)


@njit
def _sorted(lists, t, projected, y0, strip_pairs, count):
    bin_strips(lists, 0, lists.first[0, t], lists.first[0, t + 1], projected, y0, strip_pairs, count)


@njit
def _composite(strip_pairs, count, owner, projected, tile, saved):
    return composite(strip_pairs, count, owner, projected, np.float32(0.0), np.float32(0.0), tile, 0, saved, SAVED)


@njit
def _composite_backward(strip_pairs, count, owner, projected, slopes, saved, sums):
    composite_backward(strip_pairs, count, owner, projected, np.float32(0.0), np.float32(0.0), slopes, 0, saved, sums)


def _row(alpha: float, conic: tuple[float, float, float] = (0.05, 0.01, 0.04)) -> NDArray[np.float32]:
    row = np.zeros(PROJECTED, np.float32)
    row[MEAN_X], row[MEAN_Y], row[ALPHA], row[DEPTH] = 3.0, 1.2, alpha, 2.0
    row[[CONIC_A, CONIC_B, CONIC_C]] = conic
    row[RED : RED + 3] = 0.2, 0.5, 0.9
    return row


def _dark_tile() -> NDArray[np.float32]:
    tile = np.zeros(5 * PIXELS, np.float32)
    tile[:PIXELS] = 1.0
    return tile


def test_every_strip_that_has_a_pixel_of_a_gaussian_lists_it_once_and_in_order() -> None:
    rng = np.random.default_rng(5)
    params = rng.normal(size=(150, 14)).astype(np.float32)
    params[:, :3] *= 0.6
    params[:, SCALE:QUATERNION] = np.log(rng.uniform(0.01, 0.25, (150, 3)))
    params[:, OPACITY] = rng.uniform(-4.0, 4.0, 150)
    cam = camera_rows([look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))], [LENS], BOX)
    raster = binned(cam, params)
    lists = raster.lists
    longest, listed, needed = int(lists.longest[0].max()), 0, 0
    assert longest > 20
    for t in range(int(raster.columns[0] * raster.rows[0])):
        x0, y0 = TILE * (t % raster.columns[0]), TILE * (t // raster.columns[0])
        strip_pairs, count = np.full((STRIPS, longest), -1, np.int32), np.full(STRIPS, -1, np.int64)
        _sorted(lists, t, raster.projected, y0, strip_pairs, count)
        pairs = lists.pair[0, lists.first[0, t] : lists.first[0, t + 1]]
        rows = raster.projected[0, lists.owner[0, pairs]].astype(np.float64)
        dx = x0 + np.arange(PIXELS) % TILE + 0.5 - rows[:, [MEAN_X]]
        dy = y0 + np.arange(PIXELS) // TILE + 0.5 - rows[:, [MEAN_Y]]
        form = rows[:, [CONIC_A]] * dx * dx + 2.0 * rows[:, [CONIC_B]] * dx * dy + rows[:, [CONIC_C]] * dy * dy
        reached = rows[:, [ALPHA]] * np.exp(-0.5 * form) >= ALPHA_MIN * 1.0001
        for n in range(STRIPS):
            mine = strip_pairs[n, : count[n]].tolist()
            assert mine == [p for p in pairs.tolist() if p in set(mine)]
            wanted = pairs[reached[:, n * STRIP : (n + 1) * STRIP].any(axis=1)].tolist()
            assert set(wanted) <= set(mine)
            listed, needed = listed + len(mine), needed + len(wanted)
    assert needed <= listed < 1.3 * needed  # a box round an ellipse, not the whole tile


def test_nothing_is_composite_where_it_is_dark() -> None:
    opaque = np.stack([_row(0.98, (0.0, 0.0, 0.0))] * 8)
    tile, saved = _dark_tile(), np.full(8 * SAVED, 7.0, np.float32)
    strip_pairs = np.arange(8, dtype=np.int32)
    laid = _composite(strip_pairs, 8, strip_pairs, opaque, tile, saved)
    assert laid == 3  # a fiftieth of the light raster each: 8e-6 is left
    assert (tile[:STRIP] < STOP).all() and (tile[STRIP:PIXELS] == 1.0).all()
    assert (saved[3 * SAVED :] == 7.0).all()
    np.testing.assert_allclose(tile[PIXELS : PIXELS + STRIP], 0.2, rtol=1e-5)
    # One by one they make the same picture, to the last bit: what comes after is laid, and changes nothing.
    again = _dark_tile()
    for k in range(8):
        _composite(strip_pairs[k : k + 1], 1, strip_pairs, opaque, again, saved)
    np.testing.assert_array_equal(tile, again)


def test_what_is_hidden_has_no_gradient() -> None:
    rows = np.stack([_row(0.999, (0.0, 0.0, 0.0))] * 5)
    strip_pairs, tile, saved = np.arange(5, dtype=np.int32), _dark_tile(), np.zeros(5 * SAVED, np.float32)
    laid = _composite(strip_pairs, 5, strip_pairs, rows, tile, saved)
    slopes, sums = np.ones(4 * PIXELS, np.float32), np.zeros((5, SUMS), np.float32)
    _composite_backward(strip_pairs, laid, strip_pairs, rows, slopes, saved, sums)
    assert (sums[:laid, 6:] > 0.0).all() and (sums[laid:] == 0.0).all()
    assert (sums[:laid, :6] == 0.0).all()  # as opaque as they can be: no gradient of their opacity


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf, 3e38, -3e38])
@pytest.mark.parametrize("column", [MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, ALPHA])
def test_a_broken_row_leaves_light_and_the_others_sums_finite(column: int, broken: float) -> None:
    rows = np.stack([_row(0.6), _row(0.7), _row(0.5)])
    rows[1, column] = broken
    strip_pairs, tile, saved = np.arange(3, dtype=np.int32), _dark_tile(), np.zeros(3 * SAVED, np.float32)
    laid = _composite(strip_pairs, 3, strip_pairs, rows, tile, saved)
    assert laid == 3 and np.isfinite(tile).all()
    assert (tile[:PIXELS] >= 0.0).all() and (tile[:PIXELS] <= 1.0).all()
    slopes, sums = np.ones(4 * PIXELS, np.float32), np.zeros((3, SUMS), np.float32)
    _composite_backward(strip_pairs, laid, strip_pairs, rows, slopes, saved, sums)
    assert np.isfinite(sums[[0, 2]]).all()
