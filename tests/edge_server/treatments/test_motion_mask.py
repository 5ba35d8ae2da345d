"""Moving pixels of stale views count for less, and for less the older the views are."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.treatments.change_detection import compare
from edge_server.treatments.motion_mask import MotionMask, speed_px_per_ms
from tests.edge_server.treatments.pictures import MS, picture, seen, view


def masked(ages_ms: list[float], speed: float = 0.08):
    """Views of the same at several ages, before and after their treatment."""
    now_ms = 1000.0
    views, earlier = [], {}
    for k, age_ms in enumerate(ages_ms):
        camera, captured_ms = f"cam{k:02d}", now_ms - age_ms
        views.append(view(picture(100.0, speed), captured_ms, camera))
        earlier[camera] = view(picture(40.0, speed), captured_ms - 60.0, camera)
    return views, MotionMask().treat(views, earlier, round(now_ms * MS))


def test_weights_fall_with_age_and_reach_farther():
    views, treated = masked([10.0, 60.0, 90.0])
    assert [t is v for t, v in zip(treated, views)] == [True, False, False], "the youngest stay whole"
    least = [1.0 if v.weight is None else float(v.weight.min()) for v in treated]
    assert least[0] == 1.0 > least[1] > least[2] >= MotionMask().least_weight
    wide = [int((v.weight < 1.0).sum()) for v in treated[1:]]
    assert wide[1] > wide[0], "what moved is farther by now"
    assert all(v.image is w.image and v.carried_to_ns is None for v, w in zip(treated, views))


def test_what_changed_is_under_the_mask():
    _views, treated = masked([0.0, 120.0])
    moved = np.abs(picture(100.0).astype(int) - picture(220.0)).max(axis=2) > 20
    assert (treated[1].weight[moved] < 1.0).mean() > 0.9
    assert (treated[1].weight == 1.0).mean() > 0.5


def test_the_speed_of_a_patch_is_found_within_a_factor_of_two():
    before, now = seen(0.0), seen(25.0)
    assert speed_px_per_ms(before, now, compare(before, now)) == pytest.approx(0.08, rel=1.0, abs=0.0)


def test_nothing_moves_nothing_is_masked():
    views, treated = masked([0.0, 50.0, 400.0], speed=0.0)
    assert all(v is w for v, w in zip(treated, views))
