"""The network's state: a continuous-time Markov chain of M states, sampled exactly (thesis 6.2.5).

Every jump has its own instant, so sampling is exact even if the chain switches many times during a frame's
transit, and states u apart are distributed as exp(Q u) says (6.27).
"""

from __future__ import annotations

import contextlib
from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from channel_emu import emulator_constants as tuned
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import NEVER_NS, saturating_add, saturating_round


class ChainError(ValueError):
    """An invalid generator, or a chain that cannot be sampled; the message says why."""


def two_state_generator(mu1_per_ms: float, mu2_per_ms: float) -> NDArray[np.float64]:
    """Generator of the two-state chain (6.26): leaves the first state at mu1, the second at mu2."""
    return np.array([[-mu1_per_ms, mu1_per_ms], [mu2_per_ms, -mu2_per_ms]], float)


def check_generator(generator_per_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the generator (M, M), in 1/ms, with its diagonal set to minus the row's rates (6.25).

    Raises ChainError unless it is square, finite, >= 0 off the diagonal, and its rows sum to zero.
    """
    q = np.asarray(generator_per_ms, float)
    if q.ndim != 2 or q.shape[0] != q.shape[1] or q.shape[0] < 1:
        raise ChainError(f"a generator is a square matrix, got shape {q.shape}")
    if not np.isfinite(q).all():
        raise ChainError("a generator's rates are finite")
    off = q - np.diag(np.diag(q))
    if (off < 0).any():
        raise ChainError("a generator's rates from one state to another are not negative")
    rates = off.sum(1)
    if (np.abs(rates + np.diag(q)) > 1e-9 * np.maximum(rates, 1e-300)).any():
        raise ChainError("a generator's rows sum to zero (diagonal = minus the sum of the row's rates)")
    return off - np.diag(rates)


def stationary(generator_per_ms: NDArray[np.float64]) -> NDArray[np.float64]:
    """Stationary distribution, (M,): for two states (mu2, mu1)/(mu1 + mu2). Raises ChainError if not unique.

    Grassmann, Taksar and Heyman's elimination: no subtraction, so rates of 1e-9 beside 1e9 keep all digits.
    """
    q = check_generator(generator_per_ms)
    keep = _recurrent(q)
    work = (q - np.diag(np.diag(q)))[np.ix_(keep, keep)]
    for n in range(len(work) - 1, 0, -1):
        work[:n, n] /= work[n, :n].sum()
        work[:n, :n] += np.outer(work[:n, n], work[n, :n])
    weight = np.ones(len(work))
    for n in range(1, len(work)):
        weight[n] = weight[:n] @ work[:n, n]
    share = np.zeros(len(q))
    share[keep] = weight / weight.sum()
    return share


def _recurrent(q: NDArray[np.float64]) -> list[int]:
    """States of the only closed class; ChainError if there are several."""
    reach = (q > 0) | np.eye(len(q), dtype=bool)
    for k in range(len(q)):
        reach |= np.outer(reach[:, k], reach[k])
    closed = {tuple(np.flatnonzero(reach[i])) for i in range(len(q)) if (reach[i] <= reach[:, i]).all()}
    if len(closed) != 1:
        raise ChainError(
            "the chain ends in different states, so it has no single long-run distribution: "
            "name the state it starts in (initial)"
        )
    return [int(state) for state in closed.pop()]


class Chain:
    """A path of the chain, extended on demand. Instants may be queried in any order until forgotten.

    generator_per_ms: (M, M), in 1/ms.
    initial: index of the first state; None draws it from the stationary distribution.
    Raises ChainError for an invalid generator, or a chain that jumps too often to be followed.
    """

    def __init__(self, generator_per_ms: NDArray[np.float64], rng: CounterRng, initial: int | None = None) -> None:
        q = check_generator(generator_per_ms)
        self.generator_per_ms = q
        self.states = len(q)
        self._rng = rng
        off = q - np.diag(np.diag(q))
        leave = off.sum(1)
        self._leaving_rates = leave.tolist()
        with np.errstate(invalid="ignore", divide="ignore"):
            jumps = np.cumsum(off / leave[:, None], 1)
        # Cumulative jump probabilities; the last possible target gets 1 exactly, so rounding cannot miss it.
        last = np.array([np.flatnonzero(row)[-1] if row.any() else i for i, row in enumerate(off)])
        self._jumps = np.where(np.arange(self.states) >= last[:, None], 1.0, jumps).tolist()
        self._refuse_too_fast()
        self.initial = self._draw_initial() if initial is None else initial
        self._starts = [0]
        self._visited = [self.initial]
        # Number of the last sojourn; the random pair of this number gives its length and its closing jump.
        self._number = 0
        self._until = self._sojourn_end(0, self.initial)
        self._spent_ns = [0] * self.states  # in the forgotten part of the path

    def segment(self, at_ns: int) -> tuple[int, int]:
        """State at ``at_ns`` and the end of its sojourn (NEVER_NS if it never ends).

        Raises ChainError if that part of the path was forgotten, or if the chain jumps too often.
        """
        if self._until <= at_ns:
            self._extend(at_ns)
        starts = self._starts
        if at_ns >= starts[-1]:
            return self._visited[-1], self._until
        i = bisect_right(starts, at_ns) - 1
        if i < 0:
            raise ChainError(f"the chain's state at {at_ns} ns was forgotten; it is kept from {starts[0]} ns")
        return self._visited[i], starts[i + 1]

    def state(self, at_ns: int) -> int:
        return self.segment(at_ns)[0]

    def occupancy(self, until_ns: int) -> list[float]:
        """Share of [0, until) spent in each state."""
        if until_ns <= 0:
            return [float(i == self.initial) for i in range(self.states)]
        self.segment(until_ns)
        spent = list(self._spent_ns)
        for start, end, state in zip(self._starts, [*self._starts[1:], NEVER_NS], self._visited):
            if start >= until_ns:
                break
            spent[state] += min(end, until_ns) - start
        return [ns / until_ns for ns in spent]

    def forget(self, before_ns: int) -> None:
        """Drop the path before an instant, to bound the memory of a live chain."""
        first = bisect_right(self._starts, before_ns) - 1
        if first < tuned.FORGOTTEN_JUMPS:
            return
        for i in range(first):
            self._spent_ns[self._visited[i]] += self._starts[i + 1] - self._starts[i]
        del self._starts[:first], self._visited[:first]

    def _extend(self, at_ns: int) -> None:
        """Jump until the path covers ``at_ns``."""
        mark, mark_ns = self._number, self._until
        while self._until <= at_ns:
            start = self._until
            if self._number - mark == tuned.CHECKED_JUMPS:
                # The constructor's check misses this rate: e.g. fast jumps before an absorbing state.
                if (start - mark_ns) * tuned.MAX_JUMPS_PER_MS * 10 < tuned.CHECKED_JUMPS * 10**6:
                    most = 10 * tuned.MAX_JUMPS_PER_MS
                    raise ChainError(f"the chain switches more than {most:.0f} times a ms: slow it down")
                mark, mark_ns = self._number, start
            target = bisect_right(self._jumps[self._visited[-1]], self._rng.pair(self._number)[1])
            self._number += 1
            self._starts.append(start)
            self._visited.append(target)
            self._until = self._sojourn_end(start, target)

    def _sojourn_end(self, start_ns: int, state: int) -> int:
        rate = self._leaving_rates[state]
        if rate == 0.0:
            return NEVER_NS
        return saturating_add(start_ns, saturating_round(self._rng.exponential(self._number) / rate * 1e6))

    def _draw_initial(self) -> int:
        shares = np.cumsum(stationary(self.generator_per_ms))
        return min(int(np.searchsorted(shares, self._rng.uniform(0, 1), side="right")), self.states - 1)

    def _refuse_too_fast(self) -> None:
        """Raise ChainError if the long-run jump rate is unique and exceeds MAX_JUMPS_PER_MS."""
        jumps_per_ms = 0.0
        with contextlib.suppress(ChainError):
            jumps_per_ms = float(stationary(self.generator_per_ms) @ -self.generator_per_ms.diagonal())
        if jumps_per_ms > tuned.MAX_JUMPS_PER_MS:
            raise ChainError(
                f"the chain would switch {jumps_per_ms:.3g} times a ms; at most {tuned.MAX_JUMPS_PER_MS:g} are "
                "followed: slow it down"
            )
