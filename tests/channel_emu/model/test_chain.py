from __future__ import annotations

import numpy as np
import pytest

from channel_emu.model.chain import Chain, ChainError, stationary, two_state_generator
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import NEVER_NS

THREE = np.array([[-0.3, 0.2, 0.1], [0.05, -0.05, 0.0], [0.4, 0.4, -0.8]])


def path(generator, seed: int = 0, initial: int | None = None) -> Chain:
    return Chain(np.array(generator, float), CounterRng(seed, "", "channel.chain"), initial)


def sojourns(chain: Chain, until_ns: int) -> tuple[np.ndarray, np.ndarray]:
    """(lengths in ms, states) of the complete sojourns before an instant."""
    ends, states = [0], []
    while (found := chain.segment(ends[-1]))[1] <= until_ns:
        states.append(found[0])
        ends.append(found[1])
    return np.diff(ends) / 1e6, np.array(states)


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
    assert len(forgetting._starts) < 2000 < len(kept._starts)
    assert forgetting.occupancy(99 * 10**9) == kept.occupancy(99 * 10**9)
    with pytest.raises(ChainError, match="forgotten"):
        forgetting.segment(0)


def test_states_apart_are_distributed_as_the_exponential_of_the_generator_says() -> None:
    """(6.27): P(u) = exp(Q u), of three states, from the states at every fifth millisecond."""
    linalg = pytest.importorskip("scipy.linalg")
    chain = path(THREE, seed=2)
    states = np.array([chain.state(at * 5 * 10**6) for at in range(40_000)])
    for lag in (1, 3):
        expected = linalg.expm(THREE * 5 * lag)
        for state in range(3):
            later = states[lag:][states[:-lag] == state]
            found = np.bincount(later, minlength=3) / len(later)
            np.testing.assert_allclose(found, expected[state], atol=2.5 / len(later) ** 0.5)


def test_one_state_and_an_absorbing_one() -> None:
    one = path(np.zeros((1, 1)))
    assert one.segment(10**15) == (0, NEVER_NS) and one.occupancy(10**15) == [1.0]
    absorbed = path([[-1.0, 1.0], [0.0, 0.0]], initial=0)
    left = absorbed.segment(0)[1]
    assert left < 100 * 10**6 and absorbed.segment(left) == (1, NEVER_NS)
