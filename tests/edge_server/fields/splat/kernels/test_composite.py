"""A tile's strips: who reaches them, where it gets dark, and rows that no projection would write."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numpy.typing import NDArray

from edge_server.fields.common.kernels.thread_pool import CallerPool
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.buffers import Passes, camera_rows
from edge_server.fields.splat.kernels.composite import (
    KEPT,
    PIXELS,
    STOP,
    STRIP,
    STRIPS,
    SUMS,
    lay,
    lift,
    sort_into_strips,
)
from edge_server.fields.splat.kernels.project import (
    ALPHA,
    ALPHA_LEAST,
    DEPTH,
    MX,
    MY,
    OPACITY,
    PROJECTED,
    QA,
    QB,
    QC,
    QUATERNION,
    RED,
    SCALE,
    TILE,
    Gaussians,
)
from freshfield.geometry import Pinhole, look_at

BOX = SceneBox((0.0, 0.0, 0.0), 1.0, 0.05, False, 3.0, 0.05)
LENS = Pinhole(48, 40, 50.0, 50.0, 24.0, 20.0)


@njit
def _sorted(lists, t, projected, y0, who, count):
    sort_into_strips(lists, 0, lists.first[0, t], lists.first[0, t + 1], projected, y0, who, count)


@njit
def _laid(who, count, owner, projected, tile, kept):
    return lay(who, count, owner, projected, np.float32(0.0), np.float32(0.0), tile, 0, kept, KEPT)


@njit
def _lifted(who, count, owner, projected, slopes, kept, sums):
    lift(who, count, owner, projected, np.float32(0.0), np.float32(0.0), slopes, 0, kept, sums)


def _row(alpha: float, conic: tuple[float, float, float] = (0.05, 0.01, 0.04)) -> NDArray[np.float32]:
    row = np.zeros(PROJECTED, np.float32)
    row[MX], row[MY], row[ALPHA], row[DEPTH] = 3.0, 1.2, alpha, 2.0
    row[[QA, QB, QC]] = conic
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
    passes = Passes(CallerPool())
    passes.look(cam, Gaussians(params, 1, np.zeros((150, 3), np.float32)), [None])
    lists = passes.lists
    longest, listed, needed = int(lists.longest[0].max()), 0, 0
    assert longest > 20
    for t in range(int(passes.columns[0] * passes.rows[0])):
        x0, y0 = TILE * (t % passes.columns[0]), TILE * (t // passes.columns[0])
        who, count = np.full((STRIPS, longest), -1, np.int32), np.full(STRIPS, -1, np.int64)
        _sorted(lists, t, passes.projected, y0, who, count)
        pairs = lists.pair[0, lists.first[0, t] : lists.first[0, t + 1]]
        rows = passes.projected[0, lists.owner[0, pairs]].astype(np.float64)
        dx = x0 + np.arange(PIXELS) % TILE + 0.5 - rows[:, [MX]]
        dy = y0 + np.arange(PIXELS) // TILE + 0.5 - rows[:, [MY]]
        form = rows[:, [QA]] * dx * dx + 2.0 * rows[:, [QB]] * dx * dy + rows[:, [QC]] * dy * dy
        reached = rows[:, [ALPHA]] * np.exp(-0.5 * form) >= ALPHA_LEAST * 1.0001
        for n in range(STRIPS):
            mine = who[n, : count[n]].tolist()
            assert mine == [p for p in pairs.tolist() if p in set(mine)]
            wanted = pairs[reached[:, n * STRIP : (n + 1) * STRIP].any(axis=1)].tolist()
            assert set(wanted) <= set(mine)
            listed, needed = listed + len(mine), needed + len(wanted)
    assert needed <= listed < 1.3 * needed  # a box round an ellipse, not the whole tile


def test_nothing_is_laid_where_it_is_dark() -> None:
    opaque = np.stack([_row(0.98, (0.0, 0.0, 0.0))] * 8)
    tile, kept = _dark_tile(), np.full(8 * KEPT, 7.0, np.float32)
    who = np.arange(8, dtype=np.int32)
    laid = _laid(who, 8, who, opaque, tile, kept)
    assert laid == 3  # a fiftieth of the light passes each: 8e-6 is left
    assert (tile[:STRIP] < STOP).all() and (tile[STRIP:PIXELS] == 1.0).all()
    assert (kept[3 * KEPT :] == 7.0).all()
    np.testing.assert_allclose(tile[PIXELS : PIXELS + STRIP], 0.2, rtol=1e-5)
    # One by one they make the same picture, to the last bit: what comes after is laid, and changes nothing.
    again = _dark_tile()
    for k in range(8):
        _laid(who[k : k + 1], 1, who, opaque, again, kept)
    np.testing.assert_array_equal(tile, again)


def test_what_is_hidden_has_no_gradient() -> None:
    rows = np.stack([_row(0.999, (0.0, 0.0, 0.0))] * 5)
    who, tile, kept = np.arange(5, dtype=np.int32), _dark_tile(), np.zeros(5 * KEPT, np.float32)
    laid = _laid(who, 5, who, rows, tile, kept)
    slopes, sums = np.ones(4 * PIXELS, np.float32), np.zeros((5, SUMS), np.float32)
    _lifted(who, laid, who, rows, slopes, kept, sums)
    assert (sums[:laid, 6:] > 0.0).all() and (sums[laid:] == 0.0).all()
    assert (sums[:laid, :6] == 0.0).all()  # as opaque as they can be: no gradient of their opacity


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf, 3e38, -3e38])
@pytest.mark.parametrize("column", [MX, MY, QA, QB, QC, ALPHA])
def test_a_broken_row_leaves_light_and_the_others_sums_finite(column: int, broken: float) -> None:
    rows = np.stack([_row(0.6), _row(0.7), _row(0.5)])
    rows[1, column] = broken
    who, tile, kept = np.arange(3, dtype=np.int32), _dark_tile(), np.zeros(3 * KEPT, np.float32)
    laid = _laid(who, 3, who, rows, tile, kept)
    assert laid == 3 and np.isfinite(tile).all()
    assert (tile[:PIXELS] >= 0.0).all() and (tile[:PIXELS] <= 1.0).all()
    slopes, sums = np.ones(4 * PIXELS, np.float32), np.zeros((3, SUMS), np.float32)
    _lifted(who, laid, who, rows, slopes, kept, sums)
    assert np.isfinite(sums[[0, 2]]).all()


def test_each_strip_of_a_tile_has_its_own_light() -> None:
    """``first`` says where a strip lies: the others of the tile are left alone, forward and back."""

    @njit
    def second(who, owner, projected, tile, slopes, kept, sums):
        lay(who, 1, owner, projected, np.float32(0.0), np.float32(2.0), tile, STRIP, kept, 0)
        lift(who, 1, owner, projected, np.float32(0.0), np.float32(2.0), slopes, STRIP, kept, sums)

    rows, who, sums = _row(0.6)[None], np.zeros(1, np.int32), np.zeros((2, 1, SUMS), np.float32)
    inside = np.zeros((4, STRIPS, STRIP), np.float32)
    inside[:, 1] = 1.0
    for n, slopes in enumerate((inside, 1.0 - inside)):
        tile, kept = _dark_tile(), np.zeros(KEPT, np.float32)
        second(who, who, rows, tile, slopes.reshape(-1), kept, sums[n])
    assert sums[0].all() and not sums[1].any()
    changed = (tile != _dark_tile()).reshape(5, STRIPS, STRIP).any(axis=(0, 2))
    assert changed.tolist() == [False, True, False, False]
