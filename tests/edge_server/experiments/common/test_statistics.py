"""What the seeds tell: intervals that cover, optima that are not flattered, shares of a gap."""

import math

import numpy as np
import pytest

from edge_server.experiments.common import statistics
from edge_server.experiments.common.statistics import Interval, at_its_best, crossed, interval, optimum


def test_an_interval_is_students_t_of_the_differences_of_pairs():
    common = {0: 10.0, 1: -20.0, 2: 5.0, 3: 0.0, 99: 5.0}
    pairs = {seed: common[seed] + gain for seed, gain in enumerate((1.0, 2.0, 3.0, 4.0))}
    found = statistics.paired(pairs, common)
    half = 3.182446 * 1.290994 / 2.0  # t of 3 degrees of freedom, deviation, root of four
    assert (found.mean, found.count) == (2.5, 4)
    assert (found.low, found.high) == pytest.approx((2.5 - half, 2.5 + half), rel=1e-5)
    assert found.p_value(found.low) == pytest.approx(0.05)


def test_too_few_values_have_no_interval():
    assert interval([None, 2.0]).count == 1 and math.isnan(interval([2.0]).low)
    assert interval([]).count == 0 and interval([2.0]).above(1.0) is None
    for bound, above in ((0.4, True), (1.6, False), (1.0, None), (1.5, None)):  # its end is part of it
        assert Interval(1.0, 0.5, 1.5, 9).above(bound) is above
    assert Interval(1.0, 1.0, 1.0, 9).above(1.0) is False  # all values alike


def test_verdicts_are_decided_by_benjamini_and_hochbergs_procedure():
    # Rejected are all up to the last p-value of rank k that is at most 0.05 k / 5: here .01, .02, .03.
    assert statistics.discoveries([0.6, 0.03, 0.01, 0.045, 0.02]) == [False, True, True, False, True]
    assert statistics.discoveries([]) == []


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
    # Both halves of the seeds have their best at the end, by less than the seeds differ by.
    by_chance = {1.0: [-9.0] * 4, 2.0: [-1.0, 2.8, 2.8, -1.0], 3.0: [1.0] * 4}
    assert optimum({x: dict(enumerate(values)) for x, values in by_chance.items()}).interior() is None


def test_a_best_point_is_measured_on_seeds_that_did_not_choose_it():
    """Even seeds have their best at 1, odd ones at 2: what one half prefers is the worse one for the
    other."""
    curve = {1.0: {s: 10.0 * (s % 2 == 0) for s in range(8)}, 2.0: {s: 10.0 * (s % 2) for s in range(8)}}
    assert at_its_best(curve) == dict.fromkeys(range(8), 0.0)  # chosen by themselves all would have 10
    assert at_its_best(curve, lower_is_better=True) == dict.fromkeys(range(8), 10.0)
    found = optimum(curve)
    assert (found.over_first.mean, found.over_last.mean) == (-5.0, -5.0)
    assert at_its_best({}) == at_its_best({1.0: {0: None}}) == {}
    gaps = optimum({1.0: {0: None, 1: 2.0}, 2.0: {0: 1.0, 1: None}})  # no seed has a value at both
    assert math.isnan(gaps.x) and gaps.interior() is None


def test_an_interval_over_runs_and_seeds_covers_what_it_says():
    """Differences of three trainings that vary, tried on the same 60 seeds, whose mean is nought: pairing has taken out
    what seeds have in common, which is where the interval is narrowest for what it holds."""
    rng = np.random.default_rng(3)
    covered = by_seeds = 0
    for _ in range(500):
        table = rng.normal(size=(3, 1)) + rng.normal(size=(3, 60))
        found = crossed([dict(enumerate(run)) for run in table.tolist()])
        alone = interval(table.mean(axis=0).tolist())
        covered += found.low <= 0.0 <= found.high
        by_seeds += alone.low <= 0.0 <= alone.high
    assert 465 <= covered <= 493
    assert by_seeds < 250, "the interval that leaves the trainings out"


def test_runs_and_seeds_where_there_are_few_of_either():
    assert crossed([]).count == 0
    one = {0: 1.0, 1: 2.0, 2: 4.0}
    assert crossed([one]) == interval(list(one.values()))
    with_gap = crossed([one, {0: 2.0, 1: None, 2: 5.0}])
    assert with_gap.count == 2 and with_gap.mean == 3.0
    assert math.isnan(crossed([{0: 1.0}, {0: 2.0}]).low)
    level = crossed([{0: 1.0, 1: 1.0}, {0: 1.0, 1: 1.0}])
    assert (level.low, level.mean, level.high) == (1.0, 1.0, 1.0)
