"""Ages by hand; ``test_closed_forms`` compares them with theory."""

from __future__ import annotations

import numpy as np
import pytest

from channel_emu.model import ages


def test_ages_by_hand() -> None:
    """Generated at 0, 10, 20 ms; delivered at 5, 40, 30: the second comes too late to matter."""
    saw = ages.sawtooth(np.array([5, 40, 30]) * 10**6, np.array([0, 10, 20]) * 10**6, 50 * 10**6)
    assert saw.delivered_ns.tolist() == [5 * 10**6, 30 * 10**6]
    # Teeth: 5 -> 30 over 25 ms, then 10 -> 30 over 20 ms.
    assert ages.mean_age_ms(saw) == pytest.approx((25 * 17.5 + 20 * 20) / 45)
    assert ages.peak_age_ms(saw) == pytest.approx(30)
    # At 5, 10, ..., 25: 5 10 15 20 25; at 30, ..., 45: 10 15 20 25.
    assert ages.query_age_ms(saw, 5.0) == pytest.approx((75 + 70) / 9)


def test_no_delivery_has_no_age() -> None:
    nothing = ages.sawtooth(np.zeros(0, np.int64), np.zeros(0, np.int64), 10**9)
    assert ages.mean_age_ms(nothing) is None and ages.peak_age_ms(nothing) is None
    assert ages.query_age_ms(nothing, 1.0) is None
