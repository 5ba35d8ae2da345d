"""Random numbers that are looked up by number, and the Markov chain, arrivals and delays drawn from them."""

import math

import numpy as np
import pytest
from scipy import linalg, stats

from channel_emu.model.chain import Chain, ChainError, stationary, two_state_generator
from channel_emu.model.counter_rng import CounterRng, _unit, philox4x32, stream_key
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.service_time import ServiceTime, exponential, gamma, lognormal, replayed
from channel_emu.model.traffic import PoissonArrivals, completion_ns
from tests.support import refused

THREE = np.array([[-0.3, 0.2, 0.1], [0.05, -0.05, 0.0], [0.4, 0.4, -0.8]])


RNG = CounterRng(5, "c", "s")


def drawn(generator, seed: int = 0, initial: int | None = None) -> Chain:
    return Chain(np.array(generator, float), CounterRng(seed, "", "channel.chain"), initial)


def test_stationary_distribution_keeps_its_digits():
    np.testing.assert_allclose(stationary(two_state_generator(0.2, 0.5)), [5 / 7, 2 / 7], rtol=1e-15)
    np.testing.assert_allclose(stationary(two_state_generator(1e-9, 1e9)), [1, 1e-18], rtol=1e-12)
    np.testing.assert_allclose(stationary(THREE) @ THREE, 0, atol=1e-16)
    # An absorbing state holds everything in the end.
    np.testing.assert_array_equal(stationary(np.array([[-1.0, 1.0], [0.0, 0.0]])), [0, 1])


def test_generators_that_are_none_are_refused():
    for wrong, why in (
        (np.zeros((2, 3)), "square"),
        ([[-1.0, 1.0], [np.inf, -np.inf]], "finite"),
        ([[1.0, -1.0], [1.0, -1.0]], "not negative"),
        (np.zeros((2, 2)), "different states"),
    ):
        refused(ChainError, why, stationary, np.array(wrong))


def test_sojourns_last_and_states_change_as_the_generator_says():
    """Mean sojourns, and (6.27): P(u) = exp(Q u) for the states a while apart, at every fifth millisecond."""
    chain, ends, sojourns = drawn(THREE, seed=2), [0], []
    while ends[-1] < 200_000 * 10**6:
        state, end = chain.segment(ends[-1])
        sojourns.append(state)
        ends.append(end)
    for state, mean in enumerate((1 / 0.3, 1 / 0.05, 1 / 0.8)):
        found = np.diff(ends)[np.array(sojourns) == state] / 1e6
        assert found.mean() == pytest.approx(mean, rel=3 / len(found) ** 0.5)
        assert found.std() == pytest.approx(mean, rel=0.08)  # exponential: deviation equals mean
    np.testing.assert_allclose(chain.occupancy(ends[-1]), stationary(THREE), rtol=0.05)
    states = np.array([chain.state(at * 5 * 10**6) for at in range(40_000)])
    for lag in (1, 3):
        expected = linalg.expm(THREE * 5 * lag)
        for state in range(3):
            later = states[lag:][states[:-lag] == state]
            found = np.bincount(later, minlength=3) / len(later)
            np.testing.assert_allclose(found, expected[state], atol=2.5 / len(later) ** 0.5)


def test_the_path_does_not_depend_on_how_it_is_asked_and_forgetting_keeps_its_shares():
    at = np.random.default_rng(0).integers(0, 10**11, 500)
    kept, anyhow, forgetting = drawn(THREE), drawn(THREE), drawn(THREE)
    in_order = {int(t): kept.state(int(t)) for t in sorted(at)}
    assert {int(t): anyhow.state(int(t)) for t in at} == in_order
    for second in range(1, 100):
        now = second * 10**9
        assert kept.segment(now) == forgetting.segment(now)
        forgetting.forget(now - 10**9)
    assert len(forgetting._starts) < 2000 < len(kept._starts)
    assert forgetting.occupancy(99 * 10**9) == kept.occupancy(99 * 10**9)
    refused(ChainError, "forgotten", forgetting.segment, 0)


def test_one_state_and_an_absorbing_one():
    one = drawn(np.zeros((1, 1)))
    assert one.segment(10**15) == (0, NEVER_NS) and one.occupancy(10**15) == [1.0]
    absorbed = drawn([[-1.0, 1.0], [0.0, 0.0]], initial=0)
    left = absorbed.segment(0)[1]
    assert left < 100 * 10**6 and absorbed.segment(left) == (1, NEVER_NS)


def test_philox_gives_its_authors_known_answers():
    for counter, key, words in (
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    ):
        assert philox4x32(counter, key) == words


def test_streams_differ_by_seed_camera_and_purpose_and_by_nothing_else():
    words = [(seed, "cam03", "channel.service") for seed in (7, 8, 7 + 2**32)]
    words += [(7, "cam04", "channel.service"), (7, "cam03", "channel.loss")]
    assert len({stream_key(*each) for each in words * 2}) == 5
    for seed in (-1, 2**63):
        refused(ValueError, "seed", stream_key, seed, "a", "b")


def test_never_zero_and_never_one():
    assert _unit(0, 0) > 0.0 and _unit(2**32 - 1, 2**32 - 1) < 1.0


def test_mmpp_counts_have_the_mean_and_variance_of_theory():
    """Var N(w) = mean w + 2 (l1 - l2)² p1 p2 (w/r - (1 - e^(-rw))/r²); the Poisson part alone is far off."""
    mu1, mu2, rates, window, horizon_ms = 1 / 300, 1 / 150, (1 / 120, 1 / 10), 200.0, 4_000_000
    arrivals = PoissonArrivals(
        rates, drawn(two_state_generator(mu1, mu2), 3), CounterRng(3, "cam00", "channel.arrivals")
    )
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


def test_spending_follows_the_state():
    """From the first state at rate 1 a ms to the absorbing second at rate 2: checked by hand."""
    path = drawn(two_state_generator(1.0, 0.0), 1, 0)
    ((_, until),) = [path.segment(0)]
    at_ms = until / 1e6
    assert completion_ns(at_ms / 2, [1e-6, 2e-6], path, 0) == pytest.approx(until / 2, abs=1)
    assert completion_ns(at_ms + 3.0, [1e-6, 2e-6], path, 0) == pytest.approx(until + 1.5e6, abs=1)
    assert completion_ns(at_ms + 3.0, [1e-6, 0.0], path, 0) == NEVER_NS


@pytest.mark.parametrize("law", ["exponential", "gamma 3", "gamma 0.5", "lognormal"])
def test_delay_laws_have_their_shape_and_a_mean_of_one(law):
    """Kolmogorov and Smirnov against scipy's distributions."""
    shape, exact = {
        "exponential": (exponential(RNG), stats.expon()),
        "gamma 3": (gamma(RNG, 3.0), stats.gamma(3.0, scale=1 / 3.0)),
        "gamma 0.5": (gamma(RNG, 0.5), stats.gamma(0.5, scale=2.0)),
        "lognormal": (lognormal(RNG, 0.7), stats.lognorm(0.7, scale=math.exp(-(0.7**2) / 2))),
    }[law]
    assert stats.kstest([shape(n) for n in range(4000)], exact.cdf).pvalue > 1e-3


def test_service_at_start_keeps_the_delay_of_the_state_it_started_in():
    assert [replayed([1.0, 2.0, 6.0])(n) for n in range(4)] == [1.0, 2.0, 6.0, 1.0]
    path = drawn(two_state_generator(1.0, 1e-6), initial=0)
    switch = path.segment(0)[1]
    service = ServiceTime(replayed([1.0]), [10.0, 1000.0], path)
    assert service.due_ns(0, 0) == (10 * 10**6, 0)
    assert service.due_ns(switch, 1) == (switch + 1000 * 10**6, 1)
    modulated = ServiceTime(replayed([1.0]), [10.0, 1000.0], path, modulated=True)
    left = 1.0 - switch / 10e6  # of the work, after the first state's share
    assert modulated.due_ns(0, 0)[0] == pytest.approx(switch + left * 1000e6, abs=2)
