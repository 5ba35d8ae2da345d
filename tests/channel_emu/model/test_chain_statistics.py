"""Chain and arrivals against theory at the 1 % level, by checks that a 2 % error does not pass.

Each check is a function of a path and of the generator that it is held against. It is run twice: against
the generator that made the path, and against one that is 2 % off, which it must reject. The paths are so long
that the statistical error is a third of the tolerance or less.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

pytest.importorskip("numba", reason="paths this long are drawn by the kernel")

from channel_emu.model.chain import Chain, stationary, transition_matrix, two_state_generator
from channel_emu.model.counter_rng import CounterRng
from channel_emu.virtual.kernels.chain_path import chain_path, poisson_arrivals

TOLERANCE = 0.01
OFF = 1.02
NS = 1e6
THREE = np.array([[-0.3, 0.2, 0.1], [0.05, -0.05, 0.0], [0.4, 0.4, -0.8]])
# In its second state a tenth of the time, so that an error of a rate is one of the share.
TWO = two_state_generator(1 / 90, 1 / 10)
EVEN = two_state_generator(1 / 30, 1 / 30)
Path = tuple[np.ndarray, np.ndarray]


def draw(generator: np.ndarray, sojourns: int, slot_ms: float | None = None) -> Path:
    """Start instants (S + 1,) and states (S,) of about that many sojourns."""
    chain = Chain(generator, CounterRng(1, "", "channel.chain"), None, slot_ms)
    rate = -stationary(generator) @ np.diag(generator)
    key = np.array(CounterRng(1, "", "channel.chain").key, np.uint64)
    return chain_path(chain.sojourn_rate, chain.jumps, chain.slot_ns, key, chain.initial, int(sojourns / rate * NS))


def at_multiples(path: Path, span_ms: float) -> np.ndarray:
    """The state at 0, span, 2 span, ..."""
    starts, states = path
    at = np.arange(0, starts[-2], round(span_ms * NS))
    return states[np.searchsorted(starts[:-1], at, side="right") - 1]


def close(found: np.ndarray | float, theory: np.ndarray | float) -> bool:
    return bool(np.all(np.abs(np.asarray(found) / np.asarray(theory) - 1) < TOLERANCE))


def occupancy(path: Path, generator: np.ndarray) -> bool:
    starts, states = path
    spent = np.bincount(states[:-1], np.diff(starts[:-1]), len(generator))
    return close(spent / spent.sum(), stationary(generator))


def sojourns(path: Path, generator: np.ndarray) -> bool:
    """Mean of each state's; and that they are exponential: their median is ln 2 of it."""
    starts, states = path
    lengths = np.diff(starts[:-1]) / NS
    means = -1 / np.diag(generator)
    of = [lengths[states[:-1] == state] for state in range(len(generator))]
    return close([x.mean() for x in of], means) and close([np.median(x) for x in of], math.log(2) * means)


def autocorrelation(path: Path, generator: np.ndarray) -> bool:
    """e^(-(a + b) u), as the rate that it gives, at u = 1 / (a + b) of the theory."""
    rate = generator[0, 1] + generator[1, 0]
    series = at_multiples(path, 1 / rate).astype(float)
    series -= series.mean()
    return close(-math.log((series[1:] * series[:-1]).mean() / series.var()) * rate, rate)


def transitions(path: Path, generator: np.ndarray, span_ms: float) -> bool:
    """Each probability of leaving a state within a span."""
    series = at_multiples(path, span_ms)
    p = transition_matrix(generator, span_ms)
    found = [np.mean(series[1:][series[:-1] == state] != state) for state in range(len(generator))]
    return close(found, 1 - np.diag(p))


def one_rate_off(generator: np.ndarray, row: int, column: int) -> np.ndarray:
    off = generator.copy()
    off[row, column] *= OFF
    off[row, row] -= off[row].sum()
    return off


CHECKS: list[tuple[str, Callable[..., bool], np.ndarray, np.ndarray, int]] = [
    ("occupancy of two states", occupancy, TWO, one_rate_off(TWO, 0, 1), 1_000_000),
    ("occupancy of two states, the way back", occupancy, TWO, one_rate_off(TWO, 1, 0), 1_000_000),
    ("sojourns in two states", sojourns, TWO, one_rate_off(TWO, 0, 1), 1_000_000),
    ("sojourns in three states", sojourns, THREE, OFF * THREE, 1_500_000),
    ("autocorrelation", autocorrelation, EVEN, OFF * EVEN, 1_500_000),
]


@pytest.mark.parametrize(("check", "generator", "off", "count"), [c[1:] for c in CHECKS], ids=[c[0] for c in CHECKS])
def test_chain_in_continuous_time(
    check: Callable[..., bool], generator: np.ndarray, off: np.ndarray, count: int
) -> None:
    path = draw(generator, count)
    assert check(path, generator)
    assert not check(path, off)


@pytest.mark.parametrize("generator", [TWO, THREE], ids=["closed form", "matrix exponential"])
@pytest.mark.parametrize("slot_ms", [2.0, 8.0])
def test_chain_sampled_at_slots(generator: np.ndarray, slot_ms: float) -> None:
    """P(u) from slot to slot and over three; every instant of a change is a slot boundary."""
    path = draw(generator, 600_000, slot_ms)
    assert (path[0][:-1] % round(slot_ms * NS) == 0).all()
    assert occupancy(path, generator)
    for span_ms in (slot_ms, 3 * slot_ms):
        assert transitions(path, generator, span_ms)
    if slot_ms == 2.0:  # over longer slots a rate's error no longer shows in full
        assert not transitions(path, OFF * generator, slot_ms)


def test_variance_of_mmpp_counts() -> None:
    """Var N(w) = mean w + 2 (l1 - l2)² p1 p2 (w/r - (1 - e^(-rw))/r²), at rw = 10, where it goes with 1/r."""
    mu, rates, window_ms, windows = 1 / 12, np.array([0.05, 1.5]), 60.0, 500_000
    path = draw(two_state_generator(mu, mu), round(windows * window_ms * mu))
    key = np.array(CounterRng(1, "cam00", "channel.arrivals").key, np.uint64)
    end_ns = int((windows - 1) * window_ms * NS * 0.99)
    found = poisson_arrivals(rates / NS, *path, key, end_ns)
    counts = np.bincount(found // round(window_ms * NS))[:-1]

    def theory(mu: float, rates: np.ndarray) -> tuple[float, float]:
        r, mean = 2 * mu, window_ms * rates.mean()
        burst = window_ms / r - (1 - math.exp(-r * window_ms)) / r**2
        return mean, mean + (rates[0] - rates[1]) ** 2 / 2 * burst

    mean, variance = theory(mu, rates)
    assert close(counts.mean(), mean) and close(counts.var(), variance)
    assert not close(counts.var(), theory(OFF * mu, rates)[1])
    assert not close(counts.mean(), theory(mu, OFF * rates)[0])
    assert not close(counts.var(), theory(mu, OFF * rates)[1])
