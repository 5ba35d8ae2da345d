"""The sequential test: no false detection for any kind of rewards, and quick true ones."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from edge_server.scheduler.online.sequential_test import MIN_REWARDS, WINDOW, Estimate, SequentialTest

Rewards = Callable[[bool, float], float]
"""Who decided, and the noise of the moment -> what came of it."""


def decisions(test: SequentialTest, rewards: Rewards, count: int, seed: int = 0, rho: float = 0.0) -> int | None:
    """Decisions until detection; None: not detected. rho: autocorrelation of the noise."""
    rng = np.random.default_rng([5, seed])
    noise = 0.0
    for number in range(count):
        other = 0.5 if test.is_suspicious else 0.15
        probability = other if test.better else 1.0 - other
        learned = bool(rng.random() < probability)
        noise = rho * noise + np.sqrt(1.0 - rho * rho) * float(rng.standard_normal())
        if test.update(learned, probability, rewards(learned, noise)):
            return number + 1
    return None


SAME: dict[str, tuple[Rewards, float]] = {
    "independent": (lambda learned, noise: noise, 0.0),
    "staying": (lambda learned, noise: noise, 0.8),
    "nearly standing": (lambda learned, noise: noise, 0.99),
    "the fixed one varies more": (lambda learned, noise: noise * (1.0 if learned else 4.0), 0.5),
    "the learned one varies more": (lambda learned, noise: noise * (4.0 if learned else 1.0), 0.5),
    "accidents": (lambda learned, noise: noise if abs(noise) < 2.0 else 1e9 * noise, 0.0),
    "constant": (lambda learned, noise: 0.7, 0.0),
    "two values": (lambda learned, noise: float(noise > 1.0), 0.0),
}


@pytest.mark.parametrize("better", [False, True])
@pytest.mark.parametrize("name", SAME)
def test_equal_policies_are_not_told_apart(name: str, better: bool):
    """Within 2000 decisions a test of 20000 has a false alarm in at most a tenth of all runs. Two 95 %
    intervals are apart in most runs of this length."""
    rewards, rho = SAME[name]
    found = [decisions(SequentialTest(better, 20_000.0), rewards, 2000, seed, rho) for seed in range(5)]
    assert found == [None] * 5


@pytest.mark.parametrize(("gap", "most"), [(0.5, 900), (1.0, 350), (3.0, 160)])
@pytest.mark.parametrize("better", [False, True])
def test_a_difference_is_found_the_sooner_the_larger_it_is(gap: float, most: int, better: bool):
    gap = gap if better else -gap
    for seed in range(5):
        found = decisions(SequentialTest(better, 20_000.0), lambda a, x: x + gap * a, 2000, seed, 0.5)
        assert found is not None and found < most
        assert decisions(SequentialTest(not better, 20_000.0), lambda a, x: x + gap * a, 500, seed, 0.5) is None


def test_a_long_good_past_does_not_delay_detection():
    test = SequentialTest(False, 20_000.0)
    assert decisions(test, lambda a, x: x + 2.0 * a, 3000) is None
    found = decisions(test, lambda a, x: x - 2.0 * a, 300, 1)
    assert found is not None


@pytest.mark.parametrize("unit", [1e-12, 1.0, 1e12])
def test_unit_and_offset_of_a_reward_do_not_matter(unit: float):
    found = {
        decisions(SequentialTest(False, 1000.0), lambda a, x, zero=zero: unit * (x - a + zero), 500)
        for zero in (0.0, -7.0)
    }
    assert len(found) == 1 and None not in found


def test_the_estimates_are_of_the_same_last_decisions():
    test = SequentialTest(False, 1e6)
    for number in range(WINDOW + 30):
        test.update(number % 2 == 0, 0.5, float(number))
    mine, other = test.estimates
    assert mine.count == other.count == WINDOW // 2
    assert (mine.mean, other.mean) == (89.0, 90.0)
    few = Estimate.of([1.0] * (MIN_REWARDS - 1))
    assert (few.mean, few.half, str(few)) == (1.0, None, "1.000")
    assert str(Estimate.of([])) == "not known yet" and "+-" in str(mine)
