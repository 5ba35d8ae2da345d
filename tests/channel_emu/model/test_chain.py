from __future__ import annotations

import math

import numpy as np
import pytest

from channel_emu.model.chain import Chain, ChainError, stationary, transition_matrix, two_state_generator
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import NEVER_NS

THREE = np.array([[-0.3, 0.2, 0.1], [0.05, -0.05, 0.0], [0.4, 0.4, -0.8]])


def path(generator, seed: int = 0, initial: int | None = None) -> Chain:
    return Chain(np.array(generator, float), CounterRng(seed, "", "channel.chain"), initial)


def sojourns(chain: Chain, until_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(lengths in ms, states) of the complete sojourns before an instant."""
    pairs = chain.recent(0, until_ns)
    starts, states = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    return np.diff(starts) / 1e6, states[:-1]


def test_transition_matrix_of_two_states_is_the_thesis_closed_form() -> None:
    mu1, mu2, u = 1 / 30, 1 / 60, 17.0
    fading = math.exp(-(mu1 + mu2) * u)
    expected = [
        [mu2 / (mu1 + mu2) + mu1 / (mu1 + mu2) * fading, mu1 / (mu1 + mu2) * (1 - fading)],
        [mu2 / (mu1 + mu2) * (1 - fading), mu1 / (mu1 + mu2) + mu2 / (mu1 + mu2) * fading],
    ]
    np.testing.assert_allclose(transition_matrix(two_state_generator(mu1, mu2), u), expected, rtol=1e-14)


@pytest.mark.parametrize("span_ms", [1e-3, 1.0, 1e6, 3e9])
def test_stiff_transition_matrices_keep_their_digits(span_ms: float) -> None:
    """Rates of 1e-9 and 1e9 together, against 200 digits: every probability to ten."""
    mpmath = pytest.importorskip("mpmath")
    for generator in (
        np.array([[-1e9, 1e9, 0.0], [1.0, -1.0 - 1e-9, 1e-9], [0.0, 1e-9, -1e-9]]),
        np.array([[-1e-9, 1e-9, 0.0], [1e9, -2e9, 1e9], [0.0, 0.0, 0.0]]),
        two_state_generator(1e-9, 1e9),
    ):
        with mpmath.workdps(200):
            exact_q = mpmath.matrix(generator.tolist())
            for i in range(len(generator)):  # the diagonal to all digits too
                exact_q[i, i] = -sum(exact_q[i, j] for j in range(len(generator)) if j != i)
            # By its eigenvalues: a series would need 1e18 terms.
            values, vectors = mpmath.eig(exact_q)
            decay = mpmath.diag([mpmath.exp(value * mpmath.mpf(span_ms)) for value in values])
            exact = (vectors * decay * vectors**-1).apply(mpmath.re)
            expected = np.array([[float(exact[i, j]) for j in range(len(generator))] for i in range(len(generator))])
        np.testing.assert_allclose(transition_matrix(generator, span_ms), expected, rtol=1e-10, atol=1e-30)


def test_stationary_distribution_keeps_its_digits() -> None:
    np.testing.assert_allclose(stationary(two_state_generator(0.2, 0.5)), [5 / 7, 2 / 7], rtol=1e-15)
    np.testing.assert_allclose(stationary(two_state_generator(1e-9, 1e9)), [1, 1e-18], rtol=1e-12)
    np.testing.assert_allclose(stationary(THREE) @ THREE, 0, atol=1e-16)
    # An absorbing state holds everything in the end.
    np.testing.assert_array_equal(stationary(np.array([[-1.0, 1.0], [0.0, 0.0]])), [0, 1])


def test_generators_that_are_none_are_refused() -> None:
    for wrong, why in (
        (np.zeros((2, 3)), "square"),
        (np.array([[-1.0, 1.0], [np.inf, -np.inf]]), "finite"),
        (np.array([[1.0, -1.0], [1.0, -1.0]]), "not negative"),
        (np.array([[-1.0, 0.5], [1.0, -1.0]]), "sum to zero"),
    ):
        with pytest.raises(ChainError, match=why):
            stationary(wrong)
    with pytest.raises(ChainError, match="different states"):
        stationary(np.zeros((2, 2)))


def test_occupancy_sojourns_and_jumps_match_theory() -> None:
    """One path of 15,000 sojourns. Standard errors are a third of the tolerances or less."""
    until_ns = 200_000 * 10**6
    chain = path(THREE)
    lengths, states = sojourns(chain, until_ns)
    for state, mean in enumerate((1 / 0.3, 1 / 0.05, 1 / 0.8)):
        found = lengths[states == state]
        assert found.mean() == pytest.approx(mean, rel=3 / len(found) ** 0.5)
        assert found.std() == pytest.approx(mean, rel=0.08)  # exponential: deviation equals mean
    leaving_third = states[1:][states[:-1] == 2]
    assert (leaving_third == 0).mean() == pytest.approx(0.5, abs=3 * 0.5 / len(leaving_third) ** 0.5)
    np.testing.assert_allclose(chain.occupancy(until_ns), stationary(THREE), rtol=0.05)


def test_autocorrelation_fades_at_the_sum_of_the_rates() -> None:
    mu1, mu2 = 1 / 30, 1 / 60
    chain = path(two_state_generator(mu1, mu2), seed=2)
    chain.segment(1_000_000 * 10**6)
    at = np.arange(0, 1_000_000, 5, dtype=np.int64) * 10**6
    pairs = chain.recent(0, int(at[-1]))
    starts, states = np.array([p[0] for p in pairs]), np.array([p[1] for p in pairs])
    series = states[np.searchsorted(starts, at, side="right") - 1].astype(float)
    series -= series.mean()
    for lag in (2, 4, 8):
        correlation = (series[:-lag] * series[lag:]).mean() / series.var()
        assert correlation == pytest.approx(math.exp(-(mu1 + mu2) * 5 * lag), abs=0.015)


def test_path_does_not_depend_on_how_it_is_asked() -> None:
    at = np.random.default_rng(0).integers(0, 10**11, 500)
    forwards, anyhow = path(THREE), path(THREE)
    in_order = {int(t): forwards.state(int(t)) for t in sorted(at)}
    assert {int(t): anyhow.state(int(t)) for t in at} == in_order


def test_forgetting_keeps_memory_bounded_and_shares_exact() -> None:
    kept, forgetting = path(THREE), path(THREE)
    for second in range(1, 100):
        now = second * 10**9
        assert kept.segment(now) == forgetting.segment(now)
        forgetting.forget(now - 10**9)
    assert len(forgetting.recent(0, 99 * 10**9)) < 2000 < len(kept.recent(0, 99 * 10**9))
    assert forgetting.occupancy(99 * 10**9) == kept.occupancy(99 * 10**9)
    with pytest.raises(ChainError, match="forgotten"):
        forgetting.segment(0)


def test_a_slot_keeps_its_state_and_slots_forget_what_was_between() -> None:
    """Switching a thousand times a slot, each slot is drawn anew: an even coin, whatever came before."""
    chain = Chain(two_state_generator(1e3, 1e3), CounterRng(0, "", "channel.chain"), 0, 1.0)
    assert all(chain.state(slot * 10**6 + 1) == chain.state(slot * 10**6 + 999_999) for slot in range(100))
    states = np.array([chain.state(slot * 10**6) for slot in range(4000)])
    assert states.mean() == pytest.approx(0.5, abs=4 * 0.5 / 4000**0.5)
    assert np.corrcoef(states[1:], states[:-1])[0, 1] == pytest.approx(0, abs=4 / 4000**0.5)


def test_slots_take_what_is_too_fast_to_follow() -> None:
    fast = np.array([[-1e9, 1e9, 0.0], [1e9, -2e9, 1e9], [0.0, 1e-9, -1e-9]])
    stiff = np.array([[-1e9, 5e8, 5e8], [1e9, -2e9, 1e9], [1e9, 1e9, -2e9]])
    with pytest.raises(ChainError, match="sampled: slots"):
        path(stiff)
    chain = Chain(stiff, CounterRng(0, "", "channel.chain"), None, 1.0)
    np.testing.assert_allclose(chain.occupancy(20_000 * 10**6), stationary(stiff), atol=0.02)
    # The state that is left once in 1e9 ms is kept.
    assert Chain(fast, CounterRng(0, "", "channel.chain"), 2, 1.0).segment(0)[1] > 10**6 * 10**6
    with pytest.raises(ChainError, match="at least a nanosecond"):
        Chain(stiff, CounterRng(0, "", "channel.chain"), None, 1e-9)


@pytest.mark.parametrize("slot_ms", [None, 1.0])
def test_degenerate_chains(slot_ms: float | None) -> None:
    """One state; and an absorbing one, in which it ends."""
    one = Chain(np.zeros((1, 1)), CounterRng(0, "", "channel.chain"), None, slot_ms)
    assert one.segment(10**15) == (0, NEVER_NS) and one.occupancy(10**15) == [1.0]
    absorbed = Chain(np.array([[-1.0, 1.0], [0.0, 0.0]]), CounterRng(0, "", "channel.chain"), 0, slot_ms)
    left = absorbed.segment(0)[1]
    assert left < 100 * 10**6 and absorbed.segment(left) == (1, NEVER_NS)
