from __future__ import annotations

import math

import numpy as np
import pytest

from channel_emu.model.chain import Chain, two_state_generator
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.service_time import ServiceTime, exponential, gamma, lognormal, replayed
from channel_emu.model.traffic import PoissonArrivals, completion_ns

RNG = CounterRng(5, "c", "s")


def chain(mu1: float, mu2: float, seed: int = 0, initial: int | None = None) -> Chain:
    return Chain(two_state_generator(mu1, mu2), CounterRng(seed, "", "channel.chain"), initial)


def test_mmpp_counts_have_the_mean_and_variance_of_theory() -> None:
    """Var N(w) = mean w + 2 (l1 - l2)² p1 p2 (w/r - (1 - e^(-rw))/r²); the Poisson part alone is far off."""
    mu1, mu2, rates, window, horizon_ms = 1 / 300, 1 / 150, (1 / 120, 1 / 10), 200.0, 4_000_000
    arrivals = PoissonArrivals(rates, chain(mu1, mu2, seed=3), CounterRng(3, "cam00", "channel.arrivals"))
    found, at_ns = [], 0
    while (at_ns := arrivals.next_ns(at_ns, len(found))) <= horizon_ms * 10**6:
        found.append(at_ns)
    counts = np.bincount(np.array(found) // round(window * 1e6), minlength=int(horizon_ms / window))
    r, p1, p2 = mu1 + mu2, mu2 / (mu1 + mu2), mu1 / (mu1 + mu2)
    mean = window * (p1 * rates[0] + p2 * rates[1])
    burst = window / r - (1 - math.exp(-r * window)) / r**2
    variance = mean + 2 * (rates[0] - rates[1]) ** 2 * p1 * p2 * burst
    assert counts.mean() == pytest.approx(mean, rel=0.03)
    assert counts.var() == pytest.approx(variance, rel=0.03)


def test_spending_follows_the_state() -> None:
    """From the first state at rate 1 a ms to the absorbing second at rate 2: checked by hand."""
    path = chain(1.0, 0.0, seed=1, initial=0)
    ((_, until),) = [path.segment(0)]
    at_ms = until / 1e6
    assert completion_ns(at_ms / 2, [1e-6, 2e-6], path, 0) == pytest.approx(until / 2, abs=1)
    assert completion_ns(at_ms + 3.0, [1e-6, 2e-6], path, 0) == pytest.approx(until + 1.5e6, abs=1)
    assert completion_ns(at_ms + 3.0, [1e-6, 0.0], path, 0) == NEVER_NS


@pytest.mark.parametrize("law", ["exponential", "gamma 3", "gamma 0.5", "lognormal"])
def test_delay_laws_have_their_shape_and_a_mean_of_one(law: str) -> None:
    """Kolmogorov and Smirnov against scipy's distributions."""
    stats = pytest.importorskip("scipy.stats")
    shape, exact = {
        "exponential": (exponential(RNG), stats.expon()),
        "gamma 3": (gamma(RNG, 3.0), stats.gamma(3.0, scale=1 / 3.0)),
        "gamma 0.5": (gamma(RNG, 0.5), stats.gamma(0.5, scale=2.0)),
        "lognormal": (lognormal(RNG, 0.7), stats.lognorm(0.7, scale=math.exp(-(0.7**2) / 2))),
    }[law]
    assert stats.kstest([shape(n) for n in range(4000)], exact.cdf).pvalue > 1e-3


def test_service_at_start_keeps_the_delay_of_the_state_it_started_in() -> None:
    assert [replayed([1.0, 2.0, 6.0])(n) for n in range(4)] == [1.0, 2.0, 6.0, 1.0]
    path = chain(1.0, 1e-6, initial=0)
    switch = path.segment(0)[1]
    service = ServiceTime(replayed([1.0]), [10.0, 1000.0], path)
    assert service.due_ns(0, 0) == (10 * 10**6, 0)
    assert service.due_ns(switch, 1) == (switch + 1000 * 10**6, 1)
    modulated = ServiceTime(replayed([1.0]), [10.0, 1000.0], path, modulated=True)
    left = 1.0 - switch / 10e6  # of the work, after the first state's share
    assert modulated.due_ns(0, 0)[0] == pytest.approx(switch + left * 1000e6, abs=2)
