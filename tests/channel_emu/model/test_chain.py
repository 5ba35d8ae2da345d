"""Random numbers that are looked up by number, and the Markov chain that is drawn from them."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from channel_emu.model.chain import Chain, ChainError, stationary, two_state_generator
from channel_emu.model.counter_rng import CounterRng, philox4x32, stream_key
from channel_emu.model.nanoseconds import NEVER_NS

THREE = np.array([[-0.3, 0.2, 0.1], [0.05, -0.05, 0.0], [0.4, 0.4, -0.8]])


def path(generator, seed: int = 0, initial: int | None = None) -> Chain:
    return Chain(np.array(generator, float), CounterRng(seed, "", "channel.chain"), initial)


def test_stationary_distribution_keeps_its_digits() -> None:
    np.testing.assert_allclose(stationary(two_state_generator(0.2, 0.5)), [5 / 7, 2 / 7], rtol=1e-15)
    np.testing.assert_allclose(stationary(two_state_generator(1e-9, 1e9)), [1, 1e-18], rtol=1e-12)
    np.testing.assert_allclose(stationary(THREE) @ THREE, 0, atol=1e-16)
    # An absorbing state holds everything in the end.
    np.testing.assert_array_equal(stationary(np.array([[-1.0, 1.0], [0.0, 0.0]])), [0, 1])


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        (np.zeros((2, 3)), "square"),
        ([[-1.0, 1.0], [np.inf, -np.inf]], "finite"),
        ([[1.0, -1.0], [1.0, -1.0]], "not negative"),
        ([[-1.0, 0.5], [1.0, -1.0]], "sum to zero"),
        (np.zeros((2, 2)), "different states"),
    ],
)
def test_generators_that_are_none_are_refused(wrong, why: str) -> None:
    with pytest.raises(ChainError, match=why):
        stationary(np.array(wrong))


def test_sojourns_last_and_states_change_as_the_generator_says() -> None:
    """Mean sojourns, and (6.27): P(u) = exp(Q u) for the states a while apart, at every fifth millisecond."""
    linalg = pytest.importorskip("scipy.linalg")
    chain, ends, sojourns = path(THREE, seed=2), [0], []
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


def test_the_path_does_not_depend_on_how_it_is_asked_and_forgetting_keeps_its_shares() -> None:
    at = np.random.default_rng(0).integers(0, 10**11, 500)
    kept, anyhow, forgetting = path(THREE), path(THREE), path(THREE)
    in_order = {int(t): kept.state(int(t)) for t in sorted(at)}
    assert {int(t): anyhow.state(int(t)) for t in at} == in_order
    for second in range(1, 100):
        now = second * 10**9
        assert kept.segment(now) == forgetting.segment(now)
        forgetting.forget(now - 10**9)
    assert len(forgetting._starts) < 2000 < len(kept._starts)
    assert forgetting.occupancy(99 * 10**9) == kept.occupancy(99 * 10**9)
    with pytest.raises(ChainError, match="forgotten"):
        forgetting.segment(0)


def test_one_state_and_an_absorbing_one() -> None:
    one = path(np.zeros((1, 1)))
    assert one.segment(10**15) == (0, NEVER_NS) and one.occupancy(10**15) == [1.0]
    absorbed = path([[-1.0, 1.0], [0.0, 0.0]], initial=0)
    left = absorbed.segment(0)[1]
    assert left < 100 * 10**6 and absorbed.segment(left) == (1, NEVER_NS)


@pytest.mark.parametrize(
    ("counter", "key", "words"),
    [
        ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
        ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    ],
)
def test_philox_gives_its_authors_known_answers(counter, key, words) -> None:
    assert philox4x32(counter, key) == words


def test_streams_differ_by_seed_camera_and_purpose_and_by_nothing_else() -> None:
    words = [(seed, "cam03", "channel.service") for seed in (7, 8, 7 + 2**32)]
    words += [(7, "cam04", "channel.service"), (7, "cam03", "channel.loss")]
    assert len({stream_key(*each) for each in words * 2}) == 5
    for seed in (-1, 2**63):
        with pytest.raises(ValueError, match="seed"):
            stream_key(seed, "a", "b")


@given(st.integers(0, 2**62), st.integers(0, 2**31), st.integers(0, 2**63 - 1))
def test_never_zero_and_never_one(number: int, again: int, seed: int) -> None:
    u, v = CounterRng(seed, "c", "p").pair(number, again)
    assert 0.0 < u < 1.0 and 0.0 < v < 1.0
