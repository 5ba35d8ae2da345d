"""A hidden chain of two states in continuous time, fitted by expectation maximization (thesis 6.24 to 6.27).

Two things of a frame depend on the state in which its transmission starts: its delay, of a gamma distribution with
the state's mean and one shape for both states (1: exponential), and whether it is lost. Frames start at any
instants; between them the chain moves by exp(Q u) (6.27), and the expected jumps and times in the states, given
both ends of a span, have closed forms (Hobolth and Jensen, Stat. Appl. Genet. Mol. Biol. 4(1), 2005).

Recordings are cut into segments of SEGMENT_FRAMES frames, taken as independent, so that the recursions run over all
segments, and over all bootstrap samples, at once. Arrays have the axes (samples R, segments B, frames L, states 2).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from channel_emu.estimate import estimate_constants as tuned

Array = NDArray[np.float64]

_MIN_RATE, _MAX_RATE = 1e-12, 1e6
MIN_DELAY_MS = 1e-6
_LEAST = 1e-80
"""Least probability of a state, so that no scale under- or overflows."""


@dataclass(frozen=True)
class Segments:
    """Frames in the order of their starts, cut into segments.

    span_ms: (R, B, L), time since the previous frame of the segment; 0 for the first, and for padding.
    delay_ms: (R, B, L); NaN if unknown.
    lost: (R, B, L), 1 or 0; NaN if unknown.
    hides_lost: whether the delays of lost frames are unknown.
    """

    span_ms: Array
    delay_ms: Array
    lost: Array
    hides_lost: bool

    def head(self, count: int) -> Segments:
        """The first ``count`` segments."""
        return Segments(self.span_ms[:, :count], self.delay_ms[:, :count], self.lost[:, :count], self.hides_lost)

    def take(self, samples: slice | NDArray[np.int64]) -> Segments:
        """Some of the samples; spans are the same in all."""
        return replace(self, delay_ms=self.delay_ms[samples], lost=self.lost[samples])


@dataclass(frozen=True)
class TwoStates:
    """One model a sample. leave_per_ms, mean_ms, loss: (R, 2) by state. shape: (R,)."""

    leave_per_ms: Array
    mean_ms: Array
    loss: Array
    shape: Array

    def take(self, samples: slice | list[int]) -> TwoStates:
        """Some of the samples."""
        return TwoStates(self.leave_per_ms[samples], self.mean_ms[samples], self.loss[samples], self.shape[samples])

    def stationary(self) -> Array:
        """Share of time in each state, (R, 2)."""
        return self.leave_per_ms[:, ::-1] / self.leave_per_ms.sum(1, keepdims=True)

    def ordered(self, by_delay: bool) -> TwoStates:
        """The same models with the state of shorter delays, or else of fewer losses, first."""
        key = self.mean_ms if by_delay else self.loss
        place = np.argsort(key, 1, kind="stable")
        leave, mean, loss = (np.take_along_axis(a, place, 1) for a in (self.leave_per_ms, self.mean_ms, self.loss))
        return TwoStates(leave, mean, loss, self.shape)


def segments(frames: tuple[Array, Array, Array], hides_lost: bool) -> Segments:
    """Cut frames (start_ms, delay_ms, lost), in the order of their starts, into one sample of segments."""
    start, delay_ms, lost = frames
    length = min(tuned.SEGMENT_FRAMES, len(start))
    span_ms = np.diff(start, prepend=start[0])
    span_ms[::length] = 0.0
    filled = ((span_ms, 0.0), (np.maximum(delay_ms, MIN_DELAY_MS), np.nan), (lost, np.nan))
    padding = (0, -len(start) % length)
    cut = [np.pad(column, padding, constant_values=fill).reshape(1, -1, length) for column, fill in filled]
    return Segments(cut[0], cut[1], cut[2], hides_lost)


def step(model: TwoStates, data: Segments, law: str) -> tuple[TwoStates, Array, Array]:
    """One step of expectation maximization.

    law: of the delays: "gamma", "exponential", or "constant" if they say nothing about the state.
    Returns the next model, the log likelihood of the given one (R,), and the probability of the second state at
    each frame, (R, B, L).
    """
    emission, scale = _emissions(model, data, law)
    rate = model.leave_per_ms.sum(1)[:, None, None]
    share = model.stationary()
    decay = np.exp(-rate * data.span_ms)
    ahead, after, mass = _recursions(share, decay, emission)
    log_likelihood = (np.log(mass) + scale).sum((1, 2))
    states = ahead * after
    second = states[..., 1]
    following = emission[:, :, 1:] * after[:, :, 1:] / mass[:, :, 1:, None]
    before = ahead[:, :, :-1]
    span, decay = data.span_ms[:, :, 1:], decay[:, :, 1:]
    moments = (span, -np.expm1(-rate * span) / rate, span * decay)
    # Sums over all spans of joint probability over transition probability, times each moment: (2, 2, 3, R).
    sums = np.array(
        [[[(before[..., i] * following[..., j] * m).sum((1, 2)) for m in moments] for j in (0, 1)] for i in (0, 1)]
    )
    leave = np.stack([_expected(sums, share, k, 1 - k, model) / _expected(sums, share, k, k) for k in (0, 1)], 1)
    mean, shape = _delay_parameters(model, data, states, law)
    known = np.where(np.isnan(data.lost), 0.0, 1.0)[..., None] * states
    lost = (np.nan_to_num(data.lost)[..., None] * states).sum((1, 2))
    loss = lost / np.maximum(known.sum((1, 2)), 1e-300)
    return TwoStates(np.clip(leave, _MIN_RATE, _MAX_RATE), mean, loss, shape), log_likelihood, second


def maximize(model: TwoStates, data: Segments, law: str, steps: int = tuned.MOST_STEPS) -> tuple[TwoStates, Array]:
    """Take steps until they gain no sample's likelihood anything, at most three times ``steps``. Returns the models
    and their log likelihoods (R,).

    Two steps show where further ones lead; the leap there (SQUAREM: Varadhan and Roland, Scand. J. Stat. 35(2), 2008)
    is taken back for a sample that it leaves less likely.
    """
    if model.shape.size > 1 and data.lost.size > tuned.MOST_AT_ONCE:
        at_once = max(1, tuned.MOST_AT_ONCE // data.lost[0].size)
        parts = [slice(n, n + at_once) for n in range(0, model.shape.size, at_once)]
        apart = [maximize(model.take(part), data.take(part), law, steps) for part in parts]
        columns = zip(*((m.leave_per_ms, m.mean_ms, m.loss, m.shape) for m, _ in apart))
        return TwoStates(*map(np.concatenate, columns)), np.concatenate([value for _, value in apart])
    found, best = _vector(model), np.full(model.shape.size, -np.inf)
    open_ = np.arange(model.shape.size)
    for _ in range(steps):
        part = data.take(open_) if len(data.lost) > 1 else data
        begin = found[open_]
        first, log_likelihood, _ = step(_model(begin), part, law)
        second, _, _ = step(first, part, law)
        moved = _vector(first) - begin
        bent = _vector(second) - begin - 2 * moved
        size = [np.linalg.norm(v, axis=1, keepdims=True) for v in (moved, bent)]
        reach = np.clip(size[0] / np.maximum(size[1], 1e-300), 1.0, tuned.MAX_REACH)
        after, reached, _ = step(_model(begin + 2 * reach * moved + reach**2 * bent), part, law)
        gained = reached >= log_likelihood
        found[open_] = np.where(gained[:, None], _vector(after), _vector(second))
        best[open_] = np.maximum(log_likelihood, reached)
        open_ = open_[np.abs(reached - log_likelihood) >= tuned.TOLERANCE]
        if not len(open_):
            break
    return _model(found), best


def _vector(model: TwoStates) -> Array:
    """Logarithms of the parameters, and log odds of the losses, (R, 7)."""
    loss = np.clip(model.loss, 1e-12, 1 - 1e-12)
    logs = (np.log(model.leave_per_ms), np.log(model.mean_ms), np.log(loss / (1 - loss)), np.log(model.shape)[:, None])
    return np.concatenate(logs, 1)


def _model(vector: Array) -> TwoStates:
    values = np.exp(np.clip(vector, -30.0, 30.0))
    loss = values[:, 4:6] / (1 + values[:, 4:6])
    return TwoStates(values[:, :2], values[:, 2:4], loss, np.clip(values[:, 6], tuned.MIN_SHAPE, tuned.MAX_SHAPE))


def draw(model: TwoStates, data: Segments, samples: int, rng: np.random.Generator) -> Segments:
    """Samples of what the first model might have shown of frames at the same instants."""
    _, count, length = data.span_ms.shape
    chance = rng.random((length, samples, count))
    state = np.empty((samples, count, length), int)
    share = model.stationary()[0, 1]
    decay = np.exp(-model.leave_per_ms[0].sum() * data.span_ms[0])
    state[:, :, 0] = chance[0] < share
    for k in range(1, length):
        second = share + (state[:, :, k - 1] - share) * decay[:, k]
        state[:, :, k] = chance[k] < second
    shape = model.shape[0]
    delay = np.maximum(rng.gamma(shape, model.mean_ms[0][state] / shape), MIN_DELAY_MS)
    lost = np.where(np.isnan(data.lost), np.nan, rng.random(state.shape) < model.loss[0][state])
    unknown = np.isnan(data.delay_ms) & (data.lost != 1.0)
    return Segments(
        data.span_ms, np.where(unknown | (data.hides_lost & (lost == 1.0)), np.nan, delay), lost, data.hides_lost
    )


def gamma_shape(spread: Array) -> Array:
    """Shape of a gamma distribution whose mean's logarithm exceeds the mean logarithm by ``spread``, within 1.5 %
    (Minka, Estimating a gamma distribution, 2002)."""
    s = np.maximum(spread, 1e-9)
    return np.clip((3.0 - s + np.sqrt((s - 3.0) ** 2 + 24.0 * s)) / (12.0 * s), tuned.MIN_SHAPE, tuned.MAX_SHAPE)


def log_density(delay_ms: Array, mean_ms: Array, shape: Array) -> Array:
    """Logarithm of the gamma density of a mean and a shape."""
    scaled = shape / mean_ms
    constant = np.vectorize(math.lgamma)(shape)
    return shape * np.log(scaled) + (shape - 1.0) * np.log(delay_ms) - scaled * delay_ms - constant


def _emissions(model: TwoStates, data: Segments, law: str) -> tuple[Array, Array]:
    """Likelihood (R, B, L, 2) of each frame by state, scaled to a maximum of 1, and the scales' logarithms."""
    by_state = []
    with np.errstate(divide="ignore"):
        for k in (0, 1):
            p = model.loss[:, k, None, None]
            value = np.where(data.lost == 1.0, np.log(p), np.where(data.lost == 0.0, np.log1p(-p), 0.0))
            if law != "constant":
                shape, mean = model.shape[:, None, None], model.mean_ms[:, k, None, None]
                value = value + np.nan_to_num(log_density(data.delay_ms, mean, shape), nan=0.0)
            by_state.append(value)
    logs = np.stack(by_state, -1)
    scale = np.maximum(logs.max(-1), -1e15)
    return np.exp(logs - scale[..., None]), scale


def _recursions(share: Array, decay: Array, emission: Array) -> tuple[Array, Array, Array]:
    """Forward and backward probabilities (R, B, L, 2), scaled so that their product is the state's, and the
    probability (R, B, L) of each frame given the earlier ones."""
    ahead, after, mass = np.empty_like(emission), np.ones_like(emission), np.empty(emission.shape[:-1])
    at = np.broadcast_to(share[:, None], (*emission.shape[:2], 2))
    both = share[:, None]
    length = emission.shape[2]
    for k in range(length):
        if k:
            kept = decay[:, :, k, None]
            at = both + (at - both) * kept  # P(u) = 1 share + (I - 1 share) e^(-rate u)
        at = np.maximum(at, _LEAST) * emission[:, :, k]
        mass[:, :, k] = at.sum(-1)
        at = at / mass[:, :, k, None]
        ahead[:, :, k] = at
    for k in range(length - 2, -1, -1):
        value = emission[:, :, k + 1] * after[:, :, k + 1] / mass[:, :, k + 1, None]
        mixed = (value * both).sum(-1, keepdims=True)
        after[:, :, k] = mixed + (value - mixed) * decay[:, :, k + 1, None]
    return ahead, after, mass


def _expected(sums: Array, share: Array, left: int, right: int, model: TwoStates | None = None) -> Array:
    """Expected time in the state ``left`` = ``right``, or number of jumps from ``left`` to ``right``, (R,).

    The integral over a span u of P(i to left in t) P(right to j in u - t), by the moments of ``step``.
    """
    total = np.zeros(len(share))
    for i in (0, 1):
        for j in (0, 1):
            a, b = share[:, left], (i == left) - share[:, left]
            c, d = share[:, j], (right == j) - share[:, j]
            whole, once, twice = sums[i, j]
            total += a * c * whole + (a * d + b * c) * once + b * d * twice
    total = np.maximum(total, 1e-300)
    return total if model is None else total * model.leave_per_ms[:, left]


def _delay_parameters(model: TwoStates, data: Segments, states: Array, law: str) -> tuple[Array, Array]:
    """Means (R, 2) and shape (R,) that fit best, given the probabilities of the states."""
    if law == "constant":
        return model.mean_ms, model.shape
    delay = data.delay_ms
    weight = np.where(np.isnan(delay), 0.0, 1.0)[..., None] * states
    count = np.maximum(weight.sum((1, 2)), 1e-300)
    mean = (np.nan_to_num(delay)[..., None] * weight).sum((1, 2)) / count
    mean = np.maximum(mean, MIN_DELAY_MS)
    if law == "exponential":
        return mean, model.shape
    logs = (np.nan_to_num(np.log(delay))[..., None] * weight).sum((1, 2, 3))
    return mean, gamma_shape(((count * np.log(mean)).sum(1) - logs) / count.sum(1))
