"""Ages by hand, against a sum over instants, and simulated ones against theory, within 0.5 %. Rates per ms, ages in ms.

Sources: Kaul, Yates and Gruteser (INFOCOM 2012); Costa, Codreanu and Ephremides (IEEE T-IT 62(4), 2016) for
one waiting place; the other forms are derived where they stand, by renewal arguments.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from channel_emu.model.ages import RunningAge
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate

TOLERANCE = 0.005


def test_ages_by_hand() -> None:
    """Generated at 0, 20, 10 ms; delivered at 5, 30, 40: the last comes too late to matter."""
    age = RunningAge((at * 10**6, born * 10**6) for at, born in ((5, 0), (30, 20), (40, 10)))
    # Teeth: 5 -> 30 over 25 ms, then 10 -> 30 over 20 ms.
    assert age.mean_age_ms(50 * 10**6) == pytest.approx((25 * 17.5 + 20 * 20) / 45)
    assert age.peak_age_ms() == pytest.approx(30)
    one = RunningAge([(7, 3)])
    assert one.mean_age_ms(7) is None and one.peak_age_ms() is None
    # Late instants lose no nanoseconds, and a frame that comes twice changes nothing.
    start = 10**18
    late = RunningAge([(start + 3, start), (start + 5, start), (start + 10, start + 5), (start + 12, start + 5)])
    assert late.mean_age_ms(start + 13) == pytest.approx((7 * 6.5 + 3 * 6.5) / 10 / 1e6, rel=1e-12)
    assert late.peak_age_ms() == 10e-6


@given(st.lists(st.tuples(st.integers(0, 50), st.integers(0, 50)), min_size=1, max_size=30), st.integers(1, 50))
def test_the_mean_is_that_over_all_instants(steps: list[tuple[int, int]], after: int) -> None:
    """Deliveries in order of time, of frames of any age, out of order and doubled."""
    deliveries, at_ns = [], 100
    for step, old in steps:
        at_ns += step
        deliveries.append((at_ns, at_ns - old))
    middles = np.arange(deliveries[0][0], at_ns + after) + 0.5
    newest = [max(born for at, born in deliveries if at < now) for now in middles]
    expected = float((middles - newest).mean()) / 1e6
    assert RunningAge(deliveries).mean_age_ms(at_ns + after) == pytest.approx(expected)


def mm1_newest_waits(lam: float, mu: float) -> float:
    both = lam**2 + lam * mu + mu**2
    return 1 / lam + 2 / mu + lam / (lam + mu) ** 2 + 1 / (lam + mu) - 2 * (lam + mu) / both


def dg1_drop_new(period: float, mean: float, survival: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """Mean and peak age; survival(t) = P(S > t) of an array. E[K], E[K²] are sums of P(K > k) = P(S > kC)."""
    above = survival(period * np.arange(2000))
    first, second = above.sum(), ((2 * np.arange(2000) + 1) * above).sum()
    return mean + period * second / (2 * first), mean + period * first


LOGNORMAL = dg1_drop_new(1.0, 1.5, stats.lognorm(0.8, scale=1.5 * np.exp(-0.32)).sf)
THESIS = dg1_drop_new(30.0, 60.0, stats.expon(scale=60.0).sf)
# Arrivals, service, discipline, seconds, exact mean age, exact peak age where known.
CASES = {
    "M/M/1 newest waits": ("poisson:1", "exp:1ms", "newest-waits", 40, mm1_newest_waits(1.0, 1.0), None),
    "D/G/1/0": ("periodic:1ms", "lognormal:1.5ms:0.8", "drop-new", 80, *LOGNORMAL),
    "D/M/1/0, thesis": ("periodic:30ms", "exp:60ms", "drop-new", 1200, *THESIS),
}


@pytest.mark.parametrize("case", CASES)
def test_mean_age_and_peak_age(case: str) -> None:
    arrivals, service, discipline, seconds, age, peak = CASES[case]
    section = {"arrivals": arrivals, "service": service, "discipline": discipline}
    found = simulate(channel_from_mapping(section), 1, seconds, seed=5).summary()
    assert found["mean_age_ms"] == pytest.approx(age, rel=TOLERANCE)
    assert peak is None or found["peak_age_ms"] == pytest.approx(peak, rel=TOLERANCE)
