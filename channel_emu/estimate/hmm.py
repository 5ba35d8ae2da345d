"""Two-state hidden Markov model in continuous time: likelihood, maximum, intervals (thesis 6.24 to 6.27).

The hidden state is a continuous-time Markov chain with generator Q (6.26). Two kinds of observations depend
on it: a frame's delay, exponential with the mean of the state in which it started, and the arrivals, Poisson
with the rate of the state (MMPP). While ``c`` cameras wait for arrivals, the joint probability of the state
and of no arrival evolves by exp((Q - c L) u), with L the diagonal matrix of rates; an arrival multiplies it
by the rate. There is no grid of slots.

scipy maximizes the likelihood over the logarithms of the parameters; the observed information at the maximum
gives the intervals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MOST_STEPS, _START_STEPS = 300, 15
_START_EVENTS = 20_000
# Finite-difference step of a logarithm: second differences keep four digits at a log likelihood of 1e5.
_STEP = 1e-3
# The maximum counts as reached when one more step gains less log likelihood than this.
_TOLERANCE = 1e-6
_IMPOSSIBLE = 1e15
# Bound of the parameters' logarithms (1e-15 to 1e15): no product over- or underflows.
_MAX_LOG = 34.5
# With a larger standard deviation (an interval of about e^10 each way) a parameter has no interval.
_MAX_LOG_SD = 5.0
Z_95 = 1.959964


@dataclass(frozen=True)
class Timeline:
    """The observations of one chain: N events in the order of time.

    span_ms: (N,), time since the previous event.
    waiting: (N,), number of cameras that wait for an arrival during that span.
    arrived: (N,), whether the event is an arrival.
    delay_ms: (N,), delay of the frame whose transmission starts here; NaN if none does.
    origin_ms: instant of the first event.
    """

    span_ms: Array
    waiting: NDArray[np.int64]
    arrived: NDArray[np.bool_]
    delay_ms: Array
    origin_ms: float = 0.0

    def at_ms(self) -> Array:
        """Instants of the events, (N,)."""
        return self.origin_ms + np.cumsum(self.span_ms)

    def head(self, events: int) -> Timeline:
        """The first ``events`` events."""
        return Timeline(
            self.span_ms[:events], self.waiting[:events], self.arrived[:events], self.delay_ms[:events], self.origin_ms
        )


@dataclass(frozen=True)
class TwoStateModel:
    """Leaving rates, mean delays and arrival rates, each (2,) by state; None: not part of the model."""

    leave_per_ms: Array
    mean_ms: Array | None
    rate_per_ms: Array | None

    def log_parameters(self) -> Array:
        """Logarithms (P,) of all parameters: leaving rates, then means, then arrival rates, if present."""
        parts = [p for p in (self.leave_per_ms, self.mean_ms, self.rate_per_ms) if p is not None]
        return np.log(np.concatenate(parts))

    def with_logs(self, log_parameters: Array) -> TwoStateModel:
        """A model of the same kind, with parameters of the given logarithms (P,), clipped to +-_MAX_LOG."""
        pairs = iter(np.exp(np.clip(log_parameters, -_MAX_LOG, _MAX_LOG)).reshape(-1, 2))
        return TwoStateModel(
            next(pairs),
            None if self.mean_ms is None else next(pairs),
            None if self.rate_per_ms is None else next(pairs),
        )

    def ordered(self) -> TwoStateModel:
        """The same model with the state of shorter delays first; without delays, of fewer arrivals first."""
        key = self.mean_ms if self.mean_ms is not None else self.rate_per_ms
        if key is None or key[0] <= key[1]:
            return self
        flipped = [None if p is None else p[::-1] for p in (self.leave_per_ms, self.mean_ms, self.rate_per_ms)]
        assert flipped[0] is not None
        return TwoStateModel(flipped[0], flipped[1], flipped[2])


@dataclass(frozen=True)
class Estimate:
    """The maximum likelihood model.

    log_sd: (P,), standard deviations of ``model.log_parameters()``; None if the data do not determine all.
    states: of ``state_probabilities``.
    """

    model: TwoStateModel
    log_likelihood: float
    log_sd: Array | None
    states: list[Array]

    @property
    def finite(self) -> bool:
        """Whether the likelihood and the state probabilities at the maximum are finite."""
        return math.isfinite(self.log_likelihood) and all(np.isfinite(s).all() for s in self.states)

    def interval(self, place: int) -> tuple[float, float] | None:
        """95 % interval of parameter number ``place`` in ``log_parameters``; None if undetermined."""
        if self.log_sd is None or not self.log_sd[place] < _MAX_LOG_SD:
            return None
        at, reach = self.model.log_parameters()[place], Z_95 * self.log_sd[place]
        return math.exp(at - reach), math.exp(at + reach)


class _Propagator:
    """Spectral decomposition for exp(G u), where G = Q - c L = slow * P_slow + fast * P_fast; both
    eigenvalues are real and at most 0."""

    def __init__(self, model: TwoStateModel, waiting: int) -> None:
        a, b = (float(x) for x in model.leave_per_ms)
        la, lb = (0.0, 0.0) if model.rate_per_ms is None else (waiting * float(x) for x in model.rate_per_ms)
        half, skew = (a + la + b + lb) / 2, (a + la - b - lb) / 2
        self.root = math.sqrt(skew * skew + a * b)
        self.fast = -(half + self.root)
        # Determinant over the other eigenvalue, which avoids a difference of nearly equal numbers.
        self.slow = (a * lb + b * la + la * lb) / self.fast
        near = self.root + abs(skew)
        small = a * b / near
        first, second = (small, near) if skew > 0 else (near, small)
        self.p_slow = np.array([[first, a], [b, second]]) / (2 * self.root)
        self.p_fast = np.array([[second, -a], [-b, first]]) / (2 * self.root)


def _propagators(model: TwoStateModel, line: Timeline) -> Array:
    """exp(G u) (N, 2, 2) of every span."""
    from channel_emu.estimate import hmm_kernels

    each = [_Propagator(model, waiting) for waiting in range(int(line.waiting.max(initial=0)) + 1)]
    return hmm_kernels.propagate(
        np.array([(p.slow, p.fast, p.root) for p in each]),
        np.array([p.p_slow for p in each]),
        np.array([p.p_fast for p in each]),
        line.span_ms,
        line.waiting,
    )


def _emissions(model: TwoStateModel, line: Timeline) -> tuple[Array, float]:
    """Likelihood (N, 2) of each event by state, with rows scaled to a maximum of 1, and the sum of the
    scales' logarithms."""
    from channel_emu.estimate import hmm_kernels

    none = np.full(2, np.nan)
    means = none if model.mean_ms is None else model.mean_ms
    rates = none if model.rate_per_ms is None else model.rate_per_ms
    return hmm_kernels.emit(means, rates, line.delay_ms, line.arrived)


_UNIFORM = np.array([0.5, 0.5])


def log_likelihood(model: TwoStateModel, lines: Sequence[Timeline]) -> float:
    """Log likelihood of all timelines, which are independent; each initial state has probability 1/2."""
    from channel_emu.estimate import hmm_kernels

    total = 0.0
    for line in lines:
        emissions, scale = _emissions(model, line)
        total += hmm_kernels.forward(_UNIFORM, _propagators(model, line), emissions)[0] + scale
    return float(total)


def state_probabilities(model: TwoStateModel, lines: Sequence[Timeline]) -> list[Array]:
    """Probability of each state at each event given all observations, one array (N, 2) a timeline."""
    from channel_emu.estimate import hmm_kernels

    return [hmm_kernels.smooth(_UNIFORM, _propagators(model, line), _emissions(model, line)[0]) for line in lines]


def maximize(model: TwoStateModel, lines: Sequence[Timeline], steps: int) -> TwoStateModel:
    """Climb from ``model`` to a maximum of the likelihood, in at most ``steps`` iterations of L-BFGS."""
    from scipy.optimize import minimize

    moves = _STEP * np.eye(len(model.log_parameters()))

    def lost(at: Array) -> tuple[float, Array]:
        tried = [log_likelihood(model.with_logs(at + move), lines) for move in (0.0 * at, *moves, *-moves)]
        # Impossible parameters, which a long step may try, get a finite loss, so the search returns.
        value, *beside = -np.maximum(tried, -_IMPOSSIBLE)
        up, down = np.reshape(beside, (2, -1))
        return value, (up - down) / (2 * _STEP)

    begin = model.log_parameters()
    tolerance = _TOLERANCE / max(abs(log_likelihood(model, lines)), 1.0)
    found = minimize(
        lost,
        begin,
        jac=True,
        method="L-BFGS-B",
        bounds=[(-_MAX_LOG, _MAX_LOG)] * len(begin),
        options={"maxiter": steps, "ftol": tolerance, "gtol": 0.0},
    )
    return model.with_logs(found.x)


def initial_models(lines: Sequence[Timeline], delays: bool, arrivals: bool) -> list[TwoStateModel]:
    """Models to start from: sojourns of 5, 50 and 500 frames, with the faster arrivals in either state.

    delays, arrivals: see ``fit``.
    """
    has_delay = np.concatenate([line.delay_ms[~np.isnan(line.delay_ms)] for line in lines])
    mean = float(has_delay.mean()) if len(has_delay) else 1.0
    arrived = sum(int(line.arrived.sum()) for line in lines)
    exposed = sum(float(line.span_ms @ line.waiting) for line in lines)
    rate = arrived / exposed if exposed > 0 else 1.0
    seconds = sum(float(line.span_ms.sum()) for line in lines)
    between = seconds / max(len(has_delay), arrived, 1)
    out = []
    for frames in (5, 50, 500):
        leave = np.full(2, 1 / (frames * max(between, 1e-9)))
        for apart in ((0.6, 1.6), (1.6, 0.6)) if delays and arrivals else ((0.6, 1.6),):
            out.append(
                TwoStateModel(
                    leave, mean * np.array([0.6, 1.6]) if delays else None, rate * np.array(apart) if arrivals else None
                )
            )
    return out


def fit(lines: Sequence[Timeline], delays: bool, arrivals: bool) -> Estimate:
    """Maximum likelihood fit of the two-state model.

    delays, arrivals: whether the states differ in delays, in arrivals; at least one of them.
    Deterministic: a few steps from several initial models on the first part of the data, then from the best
    of them to the maximum.
    """
    first = [line.head(_START_EVENTS) for line in lines]
    candidates = [maximize(each, first, _START_STEPS) for each in initial_models(lines, delays, arrivals)]
    initial = max(candidates, key=lambda each: log_likelihood(each, first))
    model = maximize(initial, lines, MOST_STEPS).ordered()
    best = log_likelihood(model, lines)
    return Estimate(model, best, _deviations(model, lines, best), state_probabilities(model, lines))


def _deviations(model: TwoStateModel, lines: Sequence[Timeline], best: float) -> Array | None:
    """Standard deviations (P,) of the parameters' logarithms by the observed information; None if that is not
    positive definite."""
    at = model.log_parameters()
    count = len(at)
    moves = _STEP * np.eye(count)

    def value(shift: Array) -> float:
        return log_likelihood(model.with_logs(at + shift), lines)

    up, down = np.array([value(m) for m in moves]), np.array([value(-m) for m in moves])
    if not np.isfinite([best, *up, *down]).all():
        return None  # neighboring parameters are impossible
    hessian = np.diag(up + down - 2 * best)
    for i in range(count):
        for j in range(i):
            both = value(moves[i] + moves[j]) + value(-moves[i] - moves[j])
            if not np.isfinite(both):
                return None
            hessian[i, j] = hessian[j, i] = (both - up[i] - down[i] - up[j] - down[j] + 2 * best) / 2
    information = -hessian / _STEP**2
    try:
        np.linalg.cholesky(information)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(np.sqrt(np.linalg.inv(information).diagonal()))
