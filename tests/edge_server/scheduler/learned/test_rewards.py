"""Rewards as printed, as corrected, term by term; a missing metric is never a silent zero."""

from __future__ import annotations

import math

import pytest

from edge_server.experiments.rollouts.episode import Outcome
from edge_server.fidelity.scorer import Score
from edge_server.live.state import Publication
from edge_server.scheduler.learned.rewards import f_w, make_reward


def score(psnr_db=25.0, psnr_moving_db=20.0, ssim=0.9, lpips=0.2):
    return Score("cam00", 0, psnr_db, psnr_moving_db, ssim, lpips, 0.0)


def outcome(aaoi_ms=60.0, ssim=0.9, views=3.0):
    return Outcome(25.0, 20.0, ssim, 0.2, aaoi_ms, views, 0.0)


def test_the_reward_of_sets_is_519():
    found = make_reward("set").of(score())
    assert found.terms == {"psnr": 0.5, "ssim": 0.45, "lpips": -0.2}
    assert found.total == pytest.approx(0.02 * 25 + 0.5 * 0.9 - 0.2)
    assert found.complete
    assert make_reward("set", fidelity="moving").of(score()).terms["psnr_moving"] == pytest.approx(0.4)


def test_the_reward_of_waiting_is_minus_f_w():
    expected = 0.015 * 60 - 0.02 * 25 + 0.2 * 0.9 + 0.3 * 0.2  # (6.36), (6.37) as printed
    row = {"psnr_db": 25.0, "ssim": 0.9, "lpips": 0.2, "aaoi_ms": 60.0}
    assert f_w(row) == pytest.approx(expected)
    assert f_w({**row, "lpips": None}) is None
    assert make_reward("thesis").of(outcome()).total == pytest.approx(-expected)
    corrected = make_reward().of(outcome())
    assert corrected.total == pytest.approx(-expected + 2 * 0.2 * 0.9)
    assert corrected.terms["age"] == pytest.approx(-0.9)


@pytest.mark.parametrize("value", [None, math.nan, math.inf])
def test_a_missing_metric_is_reported_and_the_rest_stays_finite(value):
    found = make_reward("set").of(score(lpips=value))
    assert found.terms["lpips"] is None and found.missing == ("lpips",) and not found.complete
    assert found.total == pytest.approx(0.95)


def test_a_view_costs_its_price_in_a_simulated_update_and_in_a_live_one():
    priced = make_reward("set", views=-0.01)
    assert priced.of(outcome()).terms["views"] == pytest.approx(-0.03)
    assert priced.of(outcome()).total == pytest.approx(make_reward("set").of(outcome()).total - 0.03)
    live = Publication(0, 1.0, 10**9, None, ("a", "b"), (1.0, 2.0), 1.5, 100.0, psnr_db=20.0, ssim=0.5, lpips=0.1)
    assert priced.of(live).terms["views"] == pytest.approx(-0.02)
    assert priced.of(score()).missing == ("views",)  # a score alone does not know


def test_what_cannot_be_a_reward_is_refused():
    for words in ({"name": "best"}, {"name": "set", "fidelity": "all"}, {"name": "set", "age": math.nan}):
        with pytest.raises(ValueError):
            make_reward(**words)
