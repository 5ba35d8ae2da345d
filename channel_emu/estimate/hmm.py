"""The two-state channel behind irregular observations: likelihood, EM and intervals (thesis 6.24 to 6.27).

The state is a hidden continuous-time chain Q (6.26). Two things tell of it: the delay of a frame, exponential
with the mean of the state in which it started, and the arrivals, Poisson with the rate of the state (MMPP).
While ``c`` cameras wait for arrivals, the state and the absence of arrivals evolve by exp((Q - c L) u), L the
diagonal of rates; an arrival multiplies by its rate. Nothing is put on a grid of slots.

EM: Baum and others 1970 for the observations, Ryden, "An EM algorithm for estimation in Markov-modulated
Poisson processes", CSDA 21, 1996, for what happens between them. Newton's method on the logarithms of the
parameters ends it, and the observed information there gives the intervals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_EM_STEPS, _START_STEPS = 300, 25
_START_EVENTS = 20_000
# EM hands over to Newton once a step gains less than this.
_SETTLED = 1e-3
_NEWTON_STEPS = 12
# Of a log likelihood of 1e5, second differences at this step of a logarithm keep four digits.
_STEP = 1e-3
# Logarithms of parameters stay within this, where no product over- or underflows: 1e-15 to 1e15.
_BOX = 34.5
# A parameter known no better than to a factor of e^10 is not known.
_VAGUE = 5.0
_Z_95 = 1.959964


@dataclass(frozen=True)
class Timeline:
    """What was seen of one chain, in order of time.

    span_ms (N,): since the event before. waiting (N,): cameras waiting for an arrival during that span.
    arrived (N,) bool: the event is an arrival. delay_ms (N,): of the frame that starts here, NaN if none.
    state (N,): known state, -1 if hidden. origin_ms: instant of the first event.
    """

    span_ms: Array
    waiting: NDArray[np.int64]
    arrived: NDArray[np.bool_]
    delay_ms: Array
    state: NDArray[np.int64]
    origin_ms: float = 0.0

    def at_ms(self) -> Array:
        """Instants of the events."""
        return self.origin_ms + np.cumsum(self.span_ms)

    def head(self, events: int) -> Timeline:
        return Timeline(self.span_ms[:events], self.waiting[:events], self.arrived[:events],
                        self.delay_ms[:events], self.state[:events], self.origin_ms)  # fmt: skip


@dataclass(frozen=True)
class TwoStates:
    """Rates of leaving each state, mean delays and arrival rates by state (None: not part of the model)."""

    leave_per_ms: Array
    mean_ms: Array | None
    rate_per_ms: Array | None

    def vector(self) -> Array:
        """Logarithms of all parameters."""
        parts = [p for p in (self.leave_per_ms, self.mean_ms, self.rate_per_ms) if p is not None]
        return np.log(np.concatenate(parts))

    def like(self, vector: Array) -> TwoStates:
        """The model of the same make with the given logarithms."""
        pairs = iter(np.exp(np.clip(vector, -_BOX, _BOX)).reshape(-1, 2))
        return TwoStates(
            next(pairs),
            None if self.mean_ms is None else next(pairs),
            None if self.rate_per_ms is None else next(pairs),
        )

    def ordered(self) -> TwoStates:
        """The state of the shorter delays first; where delays tell nothing, that of the fewer arrivals."""
        key = self.mean_ms if self.mean_ms is not None else self.rate_per_ms
        if key is None or key[0] <= key[1]:
            return self
        flipped = [
            None if p is None else p[::-1] for p in (self.leave_per_ms, self.mean_ms, self.rate_per_ms)
        ]
        assert flipped[0] is not None
        return TwoStates(flipped[0], flipped[1], flipped[2])


@dataclass(frozen=True)
class Expectation:
    """Given everything seen: log likelihood; time in each state, and with cameras waiting (both ms, (2,));
    jumps out of each state (2,); the state's distribution at each event, one array (N, 2) a timeline."""

    log_likelihood: float
    time_ms: Array
    waiting_ms: Array
    jumps: Array
    states: list[Array]


@dataclass(frozen=True)
class Estimate:
    """model: the best found. log_sd: standard deviations of the logarithms, as ``model.vector()``; None where
    the data do not determine them all."""

    model: TwoStates
    log_likelihood: float
    log_sd: Array | None
    expectation: Expectation

    def interval(self, place: int) -> tuple[float, float] | None:
        """95 % interval of parameter ``place`` of the vector."""
        if self.log_sd is None or not self.log_sd[place] < _VAGUE:
            return None
        at, reach = self.model.vector()[place], _Z_95 * self.log_sd[place]
        return math.exp(at - reach), math.exp(at + reach)


class _Span:
    """Spectrum of G = Q - c L: G = slow * P_slow + fast * P_fast; both eigenvalues real and at most 0."""

    def __init__(self, model: TwoStates, waiting: int) -> None:
        a, b = (float(x) for x in model.leave_per_ms)
        la, lb = (0.0, 0.0) if model.rate_per_ms is None else (waiting * float(x) for x in model.rate_per_ms)
        half, skew = (a + la + b + lb) / 2, (a + la - b - lb) / 2
        self.root = math.sqrt(skew * skew + a * b)
        self.fast = -(half + self.root)
        # The product of the eigenvalues is the determinant: no difference of nearly equal numbers.
        self.slow = (a * lb + b * la + la * lb) / self.fast
        near = self.root + abs(skew)
        small = a * b / near
        first, second = (small, near) if skew > 0 else (near, small)
        self.p_slow = np.array([[first, a], [b, second]]) / (2 * self.root)
        self.p_fast = np.array([[second, -a], [-b, first]]) / (2 * self.root)

    def steps(self, span_ms: Array) -> Array:
        """exp(G u) (N, 2, 2) of the spans."""
        slow, apart = np.exp(self.slow * span_ms), -np.expm1(-2 * self.root * span_ms)
        fast = np.exp(self.fast * span_ms)
        out = np.empty((len(span_ms), 2, 2))
        for i in range(2):
            out[:, i, i] = slow * self.p_slow[i, i] + fast * self.p_fast[i, i]
            out[:, i, 1 - i] = slow * apart * self.p_slow[i, 1 - i]
        return out

    def moments(self, span_ms: Array, weights: Array) -> Array:
        """M (2, 2): M[i, j] = sum over spans and ends (a, b) of
        weights[a, b] * integral of exp(G s)[a, i] exp(G (u - s))[j, b] ds from 0 to u."""
        slow, fast = np.exp(self.slow * span_ms), np.exp(self.fast * span_ms)
        mixed = slow * -np.expm1(-2 * self.root * span_ms) / (2 * self.root)
        parts = ((self.p_slow, self.p_slow, span_ms * slow), (self.p_fast, self.p_fast, span_ms * fast),
                 (self.p_slow, self.p_fast, mixed), (self.p_fast, self.p_slow, mixed))  # fmt: skip
        total = np.zeros((2, 2))
        for left, right, integral in parts:
            total += left.T @ np.tensordot(integral, weights, 1) @ right.T
        return total


def _steps(model: TwoStates, line: Timeline) -> Array:
    steps = np.empty((len(line.span_ms), 2, 2))
    for waiting in np.unique(line.waiting):
        chosen = line.waiting == waiting
        steps[chosen] = _Span(model, int(waiting)).steps(line.span_ms[chosen])
    return steps


def _seen(model: TwoStates, line: Timeline) -> tuple[Array, float]:
    """Likelihood (N, 2) of each event by state, each row scaled to a largest of 1, and the log of the
    scales' product."""
    logs = np.zeros((len(line.span_ms), 2))
    if model.mean_ms is not None:
        told = ~np.isnan(line.delay_ms)
        logs[told] -= np.log(model.mean_ms) + line.delay_ms[told, None] / model.mean_ms
    if model.rate_per_ms is not None:
        logs[line.arrived] += np.log(model.rate_per_ms)
    known = np.flatnonzero(line.state >= 0)
    logs[known, 1 - line.state[known]] = -np.inf
    scale = logs.max(1)
    return np.exp(logs - scale[:, None]), float(scale.sum())


_EVEN = np.array([0.5, 0.5])


def log_likelihood(model: TwoStates, lines: Sequence[Timeline]) -> float:
    """Of all timelines, which are independent; each starts in either state alike."""
    from channel_emu.estimate import hmm_kernels

    total = 0.0
    for line in lines:
        seen, scale = _seen(model, line)
        total += hmm_kernels.log_likelihood(_EVEN, _steps(model, line), seen) + scale
    return float(total)


def expect(model: TwoStates, lines: Sequence[Timeline]) -> Expectation:
    """The E step."""
    from channel_emu.estimate import hmm_kernels

    total, time_ms, waiting_ms, jumps = 0.0, np.zeros(2), np.zeros(2), np.zeros(2)
    states = []
    for line in lines:
        seen, scale = _seen(model, line)
        steps = _steps(model, line)
        found, weights = hmm_kernels.smooth(_EVEN, steps, seen)
        total += found + scale
        states.append((weights * steps).sum(1))
        for waiting in np.unique(line.waiting):
            chosen = line.waiting == waiting
            moments = _Span(model, int(waiting)).moments(line.span_ms[chosen], weights[chosen])
            time_ms += moments.diagonal()
            waiting_ms += waiting * moments.diagonal()
            jumps += model.leave_per_ms * np.array([moments[0, 1], moments[1, 0]])
    return Expectation(float(total), time_ms, waiting_ms, jumps, states)


def _improve(model: TwoStates, lines: Sequence[Timeline], found: Expectation) -> TwoStates:
    """The M step: counts over exposures."""
    tiny = 1e-300
    leave = found.jumps / np.maximum(found.time_ms, tiny)
    mean = rate = None
    if model.mean_ms is not None:
        weight, work = np.zeros(2), np.zeros(2)
        for line, states in zip(lines, found.states):
            told = ~np.isnan(line.delay_ms)
            weight += states[told].sum(0)
            work += line.delay_ms[told] @ states[told]
        mean = np.maximum(work / np.maximum(weight, tiny), 1e-9)
    if model.rate_per_ms is not None:
        arrivals = sum((s[line.arrived].sum(0) for line, s in zip(lines, found.states)), np.zeros(2))
        rate = np.maximum(arrivals / np.maximum(found.waiting_ms, tiny), 1e-15)
    return TwoStates(np.maximum(leave, 1e-15), mean, rate)


def climb(model: TwoStates, lines: Sequence[Timeline], steps: int) -> tuple[TwoStates, float]:
    """At most so many steps of EM: the model, and a log likelihood it has reached."""
    before = -math.inf
    for _ in range(steps):
        found = expect(model, lines)
        if found.log_likelihood - before <= _SETTLED:
            return model, found.log_likelihood
        before = found.log_likelihood
        model = _improve(model, lines, found)
    return model, before


def starts(lines: Sequence[Timeline], delays: bool, arrivals: bool) -> list[TwoStates]:
    """Where to begin: states that last 5, 50 and 500 frames, delays and arrivals apart both ways round."""
    told = np.concatenate([line.delay_ms[~np.isnan(line.delay_ms)] for line in lines])
    mean = float(told.mean()) if len(told) else 1.0
    arrived = sum(int(line.arrived.sum()) for line in lines)
    exposed = sum(float(line.span_ms @ line.waiting) for line in lines)
    rate = arrived / exposed if exposed > 0 else 1.0
    seconds = sum(float(line.span_ms.sum()) for line in lines)
    between = seconds / max(len(told), arrived, 1)
    out = []
    for frames in (5, 50, 500):
        leave = np.full(2, 1 / (frames * max(between, 1e-9)))
        for apart in ((0.6, 1.6), (1.6, 0.6)) if delays and arrivals else ((0.6, 1.6),):
            out.append(TwoStates(leave, mean * np.array([0.6, 1.6]) if delays else None,
                                 rate * np.array(apart) if arrivals else None))  # fmt: skip
    return out


def fit(lines: Sequence[Timeline], delays: bool, arrivals: bool, begin: TwoStates | None = None) -> Estimate:
    """Most likely two states. delays, arrivals: what the states may differ in; at least one of them.

    Deterministic: several starts on the first part of the data, EM from the best of them (from ``begin``
    where it is given), then Newton.
    """
    if begin is None:
        first = [line.head(_START_EVENTS) for line in lines]
        climbed = [climb(model, first, _START_STEPS) for model in starts(lines, delays, arrivals)]
        begin = max(climbed, key=lambda pair: pair[1])[0]
    model, _ = climb(begin, lines, _EM_STEPS)
    model, best, log_sd = _newton(model.ordered(), lines)
    return Estimate(model, best, log_sd, expect(model, lines))


def _newton(model: TwoStates, lines: Sequence[Timeline]) -> tuple[TwoStates, float, Array | None]:
    """EM's last digits, for which it would take hundreds of steps; and the observed information."""
    at = model.vector()
    best = log_likelihood(model, lines)
    for _ in range(_NEWTON_STEPS):
        slope, bend = _derivatives(model, lines, at, best)
        try:
            np.linalg.cholesky(-bend)
            step = np.linalg.solve(-bend, slope)
        except np.linalg.LinAlgError:
            return model.like(at), best, None
        # Where the parabola is a poor guide, at most a factor of e at a time.
        step /= max(1.0, float(np.abs(step).max()))
        if float(slope @ step) < 1e-6:  # twice what is left to gain
            return model.like(at), best, np.sqrt(np.linalg.inv(-bend).diagonal())
        for _ in range(20):
            value = log_likelihood(model.like(at + step), lines)
            if value > best:
                break
            step /= 2
        else:
            return model.like(at), best, np.sqrt(np.linalg.inv(-bend).diagonal())
        at, best = at + step, value
    return model.like(at), best, None


def _derivatives(model: TwoStates, lines: Sequence[Timeline], at: Array, best: float) -> tuple[Array, Array]:
    """Slope (P,) and bend (P, P) of the log likelihood by central differences of the logarithms."""
    count = len(at)
    moves = _STEP * np.eye(count)

    def value(shift: Array) -> float:
        return log_likelihood(model.like(at + shift), lines)

    up, down = np.array([value(m) for m in moves]), np.array([value(-m) for m in moves])
    slope = (up - down) / (2 * _STEP)
    bend = np.diag(up + down - 2 * best)
    for i in range(count):
        for j in range(i):
            both = value(moves[i] + moves[j]) + value(-moves[i] - moves[j])
            bend[i, j] = bend[j, i] = (both - up[i] - down[i] - up[j] - down[j] + 2 * best) / 2
    return slope, bend / _STEP**2
