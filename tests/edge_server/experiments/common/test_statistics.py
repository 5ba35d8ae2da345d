"""What the seeds tell: intervals that cover, optima that are not flattered, shares of a gap."""

from __future__ import annotations

import math

import numpy as np
import pytest

from edge_server.experiments.common.statistics import (
    FALSE_DISCOVERY_RATE,
    Interval,
    at_its_best,
    crossed,
    discoveries,
    interval,
    optimum,
    paired,
)


def test_an_interval_covers_the_mean_in_95_of_100():
    rng = np.random.default_rng(1)
    covered = 0
    for _ in range(2000):
        found = interval(list(rng.normal(3.0, 2.0, 6)))
        covered += found.low <= 3.0 <= found.high
    assert 0.935 < covered / 2000 < 0.965


def test_too_few_values_have_no_interval():
    assert interval([None, 2.0]).count == 1 and math.isnan(interval([2.0]).low)
    assert interval([]).count == 0 and interval([2.0]).above(1.0) is None
    assert Interval(1.0, 0.5, 1.5, 9).above(0.4) is True
    assert Interval(1.0, 0.5, 1.5, 9).above(1.6) is False
    assert Interval(1.0, 0.5, 1.5, 9).above(1.0) is None
    assert Interval(1.0, 0.5, 1.5, 9).above(1.5) is None  # its end is part of it
    assert Interval(1.0, 1.0, 1.0, 9).above(1.0) is False  # all values alike


def test_the_false_discovery_rate_is_the_share_of_wrong_verdicts_among_the_decided():
    rng = np.random.default_rng(3)
    wrong = []
    for _ in range(500):  # 20 hypotheses that hold, then 20 that do not
        p_values = [*rng.uniform(size=20).tolist(), *(1e-2 * rng.uniform(size=20)).tolist()]
        found = discoveries(p_values)
        wrong.append(sum(found[:20]) / max(sum(found), 1))
        assert found == discoveries(p_values, FALSE_DISCOVERY_RATE)
    # Of all hypotheses half hold, so that Benjamini and Hochberg's procedure keeps half of the rate.
    assert np.mean(wrong) == pytest.approx(0.5 * FALSE_DISCOVERY_RATE, abs=0.005)
    assert discoveries([]) == []


def test_pairing_takes_out_what_seeds_have_in_common():
    rng = np.random.default_rng(2)
    common = rng.normal(0, 10, 20)
    a = {s: float(common[s] + 1.0 + 0.1 * rng.normal()) for s in range(20)}
    b = {s: float(common[s]) for s in range(20)} | {99: 5.0}
    found = paired(a, b)
    assert found.count == 20 and 0.9 < found.low < 1.0 < found.high < 1.1


def curve_of(shape, seeds=24, noise=0.5, seed=0):
    rng = np.random.default_rng(seed)
    xs = [10.0, 20.0, 40.0, 80.0, 160.0]
    return {x: {s: shape(x) + noise * rng.normal() for s in range(seeds)} for x in xs}


def test_an_optimum_inside_is_found_and_one_at_the_end_is_not_called_inside():
    inside = optimum(curve_of(lambda x: -abs(math.log(x / 40.0))))
    assert inside.x == 40.0 and inside.low <= 40.0 <= inside.high and inside.interior(0.1) is True
    assert optimum(curve_of(lambda x: abs(math.log(x / 40.0))), lower_is_better=True).x == 40.0
    rising = optimum(curve_of(lambda x: math.log(x)))
    assert rising.x == 160.0 and rising.interior(0.1) is False


def test_a_flat_curve_is_not_given_an_optimum():
    """The best of five equal points, measured on the seeds that chose it, would look better than the ends."""
    claimed = sum(optimum(curve_of(lambda x: 0.0, seed=s)).interior() is True for s in range(60))
    assert claimed <= 6


def test_a_best_point_is_measured_on_seeds_that_did_not_choose_it():
    """Even seeds have their best at 1, odd ones at 2: what one half prefers is the worse one for the
    other."""
    curve = {1.0: {s: 10.0 * (s % 2 == 0) for s in range(8)}, 2.0: {s: 10.0 * (s % 2) for s in range(8)}}
    assert at_its_best(curve) == dict.fromkeys(range(8), 0.0)  # chosen by themselves all would have 10
    assert at_its_best(curve, lower_is_better=True) == dict.fromkeys(range(8), 10.0)
    found = optimum(curve)
    assert (found.over_first.mean, found.over_last.mean) == (-5.0, -5.0)
    assert at_its_best({}) == at_its_best({1.0: {0: None}}) == {}


def test_seeds_that_lack_a_point_are_left_out():
    curve = curve_of(lambda x: -abs(math.log(x / 40.0)))
    curve[10.0][3] = None
    assert optimum(curve).over_last.count == 23
    with pytest.raises(ValueError, match="no seed"):
        optimum({1.0: {0: None}, 2.0: {0: 1.0}})


@pytest.mark.parametrize("spread", [0.0, 0.3, 1.0])
def test_an_interval_over_runs_and_seeds_covers_what_it_says(spread):
    """Differences of three trainings that vary by ``spread``, tried on the same 60 seeds, whose mean is nought: pairing
    has taken out what seeds have in common, which is where the interval is narrowest for what it holds."""
    rng = np.random.default_rng(3)
    covered = by_seeds = 0
    for _ in range(1000):
        table = spread * rng.normal(size=(3, 1)) + rng.normal(size=(3, 60))
        found = crossed([dict(enumerate(run)) for run in table.tolist()])
        alone = interval(table.mean(axis=0).tolist())
        assert found.mean == pytest.approx(alone.mean)
        covered += found.low <= 0.0 <= found.high
        by_seeds += alone.low <= 0.0 <= alone.high
    assert 930 <= covered <= 985
    if spread == 1.0:  # the interval that leaves the trainings out
        assert by_seeds < 500


def test_runs_and_seeds_where_there_are_few_of_either():
    assert crossed([]).count == 0
    one = {0: 1.0, 1: 2.0, 2: 4.0}
    assert crossed([one]) == interval(list(one.values()))
    with_gap = crossed([one, {0: 2.0, 1: None, 2: 5.0}])
    assert with_gap.count == 2 and with_gap.mean == 3.0
    assert math.isnan(crossed([{0: 1.0}, {0: 2.0}]).low)
    level = crossed([{0: 1.0, 1: 1.0}, {0: 1.0, 1: 1.0}])
    assert (level.low, level.mean, level.high) == (1.0, 1.0, 1.0)
