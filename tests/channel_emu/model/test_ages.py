"""Ages by hand, and against a sum over instants; ``test_closed_forms`` compares them with theory."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel_emu.model.ages import RunningAge


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
