"""Gaussians in 16 bytes: what is lost, and what hard cases become."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.page.splats.records import (
    RECORD,
    ZONE,
    contract,
    expand,
    from_records,
    noticeable,
    scale_range,
    to_records,
    weights,
)
from freshfield.geometry import quaternion_to_matrix
from tests.edge_server.page.splats.gaussians import gaussians


def covariances(params):
    turns = np.stack([quaternion_to_matrix(q / np.linalg.norm(q)) for q in params[:, 6:10].astype(float)])
    axes = turns * np.exp(params[:, None, 3:6].astype(float))
    return axes @ axes.transpose(0, 2, 1)


def test_a_record_is_the_same_ellipsoid():
    params = gaussians(500, 3)
    scales = scale_range(params)
    records = to_records(params, scales)
    assert records.itemsize == RECORD.itemsize == 16
    again = from_records(records, scales)
    np.testing.assert_allclose(again[:, :3], params[:, :3], atol=4 * 2.0**-16 * 4)
    wanted, found = covariances(params), covariances(again)
    off = np.linalg.norm(wanted - found, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
    assert np.median(off) < 0.01 and off.max() < 0.03
    np.testing.assert_allclose(again[:, 11:14], params[:, 11:14], atol=0.0041)
    alpha = lambda p: 1 / (1 + np.exp(-p[:, 10]))  # noqa: E731
    np.testing.assert_allclose(alpha(again), alpha(params), atol=0.0021)


def test_far_places_are_contracted_and_come_back():
    there = contract(places := np.array([-100.0, -1.0, -0.3, 0.0, 1.0, 1.5, 20.0]))
    assert np.abs(there).max() < 2.0
    np.testing.assert_allclose(expand(there), places, rtol=1e-12)


def test_turns_fill_the_zone_and_no_more():
    turn = to_records(gaussians(20_000, 4), (-5.0, -2.0))["turn"]
    assert turn.min() == 0 and turn.max() == 255  # bytes are neither wasted nor clipped
    quarter = np.tile(np.array([0, 0, 0, -3, -4, -5, 1, 1, 0, 0, 0, 0, 0, 0], np.float32), (1, 1))
    record = to_records(quarter, (-5.0, -3.0))
    np.testing.assert_array_equal(np.abs(record["turn"].astype(float) * 2 * ZONE / 255 - ZONE) < 0.01, True)
    assert sorted(record["scale"][0]) == [0, 128, 255]  # axes took new names instead


@pytest.mark.stability
@pytest.mark.parametrize(
    "column, value",
    [(0, np.nan), (1, np.inf), (4, np.nan), (3, 1e30), (7, np.nan), (10, np.inf), (12, -np.inf), (2, 1e30)],
)
def test_what_cannot_be_drawn_is_not_drawn_and_spoils_nothing(column, value):
    params = gaussians(20, 5).copy()
    params[7, column] = value
    scales = scale_range(params)
    records = to_records(params, scales)
    assert np.isfinite(scales).all() and scales[0] < scales[1]
    assert np.isfinite(from_records(records, scales)).all()
    assert np.isfinite(value) or records["alpha"][7] == 0
    others = np.arange(20) != 7
    kept = to_records(params[others], scales)
    np.testing.assert_array_equal(records[others], kept)
    found = weights(params)
    assert np.isfinite(found).all() and (np.isfinite(value) or found[7] == 0)
    low, high = scale_range(params[:0])
    assert low < high and len(to_records(params[:0], (low, high))) == 0


def test_larger_nearer_and_denser_ones_weigh_more():
    one = np.array([[0, 0, 0, -3, -3, -3, 1, 0, 0, 0, 0, 0, 0, 0]], np.float32)
    others = np.tile(one, (4, 1))
    others[[0, 1, 2, 3], [3, 10, 0, 0]] = -2.0, 2.0, 0.9, 4.0  # larger, denser, within the unit, far
    larger, denser, within, far = weights(others) / weights(one)
    assert larger > 2.0 and denser > 1.0 and within == 1.0 and far == pytest.approx(1 / 16)


def test_what_is_noticed():
    before = to_records(gaussians(6, 6), (-5.0, -2.0))
    now = before.copy()
    for row, (name, step) in enumerate([("place", 3), ("scale", 3), ("turn", 6), ("color", 2)]):
        now[name][row, 1] += step
    now["alpha"][4] -= 3
    assert not noticeable(before, now).any()
    now["color"][3, 1] += 1
    now["alpha"][4] -= 1
    np.testing.assert_array_equal(noticeable(before, now), [False, False, False, True, True, False])
