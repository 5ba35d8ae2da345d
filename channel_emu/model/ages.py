"""Age metrics, each a function of one link's deliveries over time (thesis 5.1 to 5.6).

``METRICS`` maps command-line names to metrics; ``measure`` evaluates one from its text, such as
``query:100ms``. Metrics that depend on a process at the sender (the source's state, its urgency) also get a
sample path of that process.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.chain import Chain, two_state_generator
from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.nanoseconds import to_ns
from channel_emu.model.notation import NotationError, rate_per_ms, span_ms

Instants = NDArray[np.int64]


@dataclass(frozen=True)
class Sawtooth:
    """The age over time, given by the deliveries that lowered it.

    From ``delivered_ns[k]`` until the next delivery or ``end_ns``, the age at time t is
    ``t - generated_ns[k]``. Both arrays are (K,), int64 ns, ascending.
    """

    delivered_ns: Instants
    generated_ns: Instants
    end_ns: int


def sawtooth(delivered_ns: Instants, generated_ns: Instants, end_ns: int) -> Sawtooth:
    """Keep only the deliveries that lower the age: an older frame than the newest one does not (5.4).

    delivered_ns, generated_ns: (N,) of all deliveries, in any order. end_ns: end of the observation.
    """
    due, born = delivered_ns, generated_ns
    if (due[1:] < due[:-1]).any():  # only where frames overtake each other
        order = np.argsort(due, kind="stable")
        due, born = due[order], born[order]
    if (born[1:] > born[:-1]).all():
        return Sawtooth(due, born, end_ns)
    newest = np.maximum.accumulate(born)
    fresh = np.ones(len(born), bool)
    fresh[1:] = born[1:] > newest[:-1]
    return Sawtooth(due[fresh], born[fresh], end_ns)


def mean_age_ms(saw: Sawtooth) -> float | None:
    """Continuous time average from the first delivery to the end; None if nothing arrived before the end."""
    return _time_average_ms(saw, saw.delivered_ns[:0], np.ones(1))


def urgency_ms(saw: Sawtooth, changes_ns: Instants, weights: NDArray[np.float64]) -> float | None:
    """Urgency of information (Zheng, Zhou, Niu, IEEE Trans. Commun. 68(12), 2020): time average of weight
    times age, where the age is the expected squared error of a Wiener process with unit variance per ms.

    changes_ns: (S,), ascending instants at which the weight changes.
    weights: (S + 1,), the weight before the first change, then after each change.
    """
    return _time_average_ms(saw, changes_ns, weights)


def query_age_ms(saw: Sawtooth, every_ms: float) -> float | None:
    """Mean age seen by queries at multiples of ``every_ms`` (or at slot boundaries, 5.2), from the first
    delivery to the end. A query sees a delivery of the same instant; if all deliveries fall on such instants,
    the mean is half of ``every_ms`` below the time average. Raises ValueError if ``every_ms`` is below 1 ns.
    """
    every_ns = to_ns(every_ms)
    if every_ns < 1:
        raise ValueError(f"queries: expected at least a nanosecond apart, got {every_ms:g} ms")
    edges = np.append(np.minimum(saw.delivered_ns, saw.end_ns), saw.end_ns)
    first = -(-edges // every_ns)  # the first instant at or after each delivery
    count = np.diff(first).astype(float)
    if not len(count) or count.sum() == 0:
        return None
    start = (first[:-1] * every_ns - saw.generated_ns).astype(float)
    return float((count * start + every_ns * count * (count - 1) / 2).sum() / count.sum() / 1e6)


def shown_age_ms(saw: Sawtooth, computing_ms: float, refresh_ms: float) -> float | None:
    """Age of what a screen shows: a frame is ready ``computing_ms`` after its delivery, and at each multiple
    of ``refresh_ms`` the screen switches to the newest frame that is ready."""
    ready = Sawtooth(saw.delivered_ns + to_ns(computing_ms), saw.generated_ns, saw.end_ns)
    at_refresh = query_age_ms(ready, refresh_ms)
    return None if at_refresh is None else at_refresh + refresh_ms / 2


def incorrect_age_ms(saw: Sawtooth, changes_ns: Instants, states: Instants) -> float | None:
    """Age of incorrect information (Maatouk et al., IEEE/ACM Trans. Netw. 28(5), 2020): time average of how
    long the receiver, which assumes the state in its newest frame, has been wrong.

    changes_ns: (S,), ascending instants at which the source's state changes.
    states: (S + 1,), the source's state before the first change, then after each change.
    """
    if not len(saw.delivered_ns) or saw.end_ns <= saw.delivered_ns[0]:
        return None
    begin = saw.delivered_ns[0]
    at = np.unique(np.concatenate((saw.delivered_ns, changes_ns[changes_ns > begin], [saw.end_ns])))
    at = at[at <= saw.end_ns]
    true = states[np.searchsorted(changes_ns, at[:-1], side="right")]
    known = states[np.searchsorted(changes_ns, newest_at(saw, at[:-1]), side="right")]
    # The end of the last interval, up to each one, in which the receiver was right.
    right_ns = np.maximum.accumulate(np.where(true == known, at[1:], begin))
    from_ns, to_ns = (at[:-1] - right_ns).astype(float), (at[1:] - right_ns).astype(float)
    area = np.where(true == known, 0.0, (to_ns - from_ns) * (to_ns + from_ns) / 2)
    return float(area.sum() / (saw.end_ns - begin) / 1e6)


def peak_age_ms(saw: Sawtooth) -> float | None:
    """Mean of the ages just before each delivery; None with fewer than two."""
    if len(saw.delivered_ns) < 2:
        return None
    return float((saw.delivered_ns[1:] - saw.generated_ns[:-1]).mean() / 1e6)


def newest_at(saw: Sawtooth, at_ns: Instants) -> Instants:
    """Generation time (T,), int64 ns, of the newest frame delivered by each instant ``at_ns`` (T,); -1 before
    the first delivery."""
    if not len(saw.delivered_ns):
        return np.full(np.shape(at_ns), -1, np.int64)
    k = np.searchsorted(saw.delivered_ns, at_ns, side="right") - 1
    return np.where(k >= 0, saw.generated_ns[np.maximum(k, 0)], -1)


def mean_of_known(values: list[float | None]) -> float | None:
    """Mean of the values that are not None, one a camera or link; None if there are none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


class Metric(NamedTuple):
    """An age metric as named on the command line, ``NAME:VALUE:VALUE``.

    about: one line of help, with an example of the values.
    values: one parser for each value.
    of: computes the metric in ms from a Sawtooth, the values and, if ``drawn``, a CounterRng.
    drawn: the metric draws a random process at the sender.
    """

    about: str
    values: tuple[Callable[[str], float], ...]
    of: Callable[..., float | None]
    drawn: bool = False


def _two_states(saw: Sawtooth, away: float, back: float, rng: CounterRng) -> tuple[Instants, Instants]:
    """Changes (S,) and states (S + 1,) of a process that leaves state 0 at the rate ``away`` and state 1 at
    ``back``, both per ms."""
    path = Chain(two_state_generator(away, back), rng, initial=0).recent(0, saw.end_ns)
    starts, states = np.array(path, np.int64).T
    return starts[1:], states


def _incorrect(saw: Sawtooth, away: float, back: float, rng: CounterRng) -> float | None:
    return incorrect_age_ms(saw, *_two_states(saw, away, back, rng))


def _urgency(saw: Sawtooth, weight: float, away: float, back: float, rng: CounterRng) -> float | None:
    changes_ns, states = _two_states(saw, away, back, rng)
    return urgency_ms(saw, changes_ns, np.where(states == 1, weight, 1.0))


def _weight(text: str) -> float:
    value = float(text)
    if not (math.isfinite(value) and value >= 0.0):
        raise ValueError(f"a weight is finite and at least 0, not {text}")
    return value


METRICS = {
    "age": Metric("time average of the age", (), mean_age_ms),
    "peak": Metric("age just before a delivery", (), peak_age_ms),
    "query": Metric("age at periodic queries, query:100ms", (span_ms,), query_age_ms),
    "shown": Metric(
        "age of what a screen shows, by computing time and refresh interval, shown:20ms:16.7ms",
        (span_ms, span_ms),
        shown_age_ms,
    ),
    "incorrect": Metric(
        "age of incorrect information about a two-state source, by transition rates, incorrect:1/2s:1/2s",
        (rate_per_ms, rate_per_ms),
        _incorrect,
        drawn=True,
    ),
    "urgency": Metric(
        "age, weighted while urgent, by weight and rates of onset and end, urgency:5:1/3s:1/1s",
        (_weight, rate_per_ms, rate_per_ms),
        _urgency,
        drawn=True,
    ),
}


def measure(text: str, saw: Sawtooth, seed: int, camera: str) -> float | None:
    """Evaluate a metric given as on the command line, such as ``query:100ms``.

    saw: the deliveries of ``camera``. seed: of the run; with ``camera`` it fixes the sender's process.
    Returns ms, None if nothing arrived. Raises NotationError for an unknown metric or a bad value.
    """
    name, *words = text.split(":")
    if name not in METRICS:
        raise NotationError(f"metric {text!r}: expected one of {', '.join(METRICS)}")
    metric = METRICS[name]
    try:
        values = [read(word) for read, word in zip(metric.values, words, strict=True)]
        return metric.of(saw, *values, *([CounterRng(seed, camera, f"age.{name}")] if metric.drawn else []))
    except ValueError:
        raise NotationError(f"metric {text!r}: {metric.about}") from None


class RunningAge:
    """Computes ``mean_age_ms`` and ``peak_age_ms`` in constant memory from deliveries added in time order."""

    def __init__(self) -> None:
        self._first_ns = self._delivered_ns = self._generated_ns = 0
        self._area = 0  # ns², whole: a float would lose the last tooth of a long run
        self._peaks_ns = 0
        self._teeth = 0

    def add(self, delivered_ns: int, generated_ns: int) -> None:
        """Add a delivery; one of an older frame changes nothing."""
        if self._teeth and generated_ns <= self._generated_ns:
            return
        if self._teeth:
            self._area += self._tooth(delivered_ns)
            self._peaks_ns += delivered_ns - self._generated_ns
        else:
            self._first_ns = delivered_ns
        self._teeth += 1
        self._delivered_ns, self._generated_ns = delivered_ns, generated_ns

    def mean_age_ms(self, end_ns: int) -> float | None:
        """Time average from the first delivery to ``end_ns``; None if nothing arrived before it."""
        if not self._teeth or end_ns <= self._first_ns:
            return None
        return (self._area + self._tooth(end_ns)) / 2 / (end_ns - self._first_ns) / 1e6

    def peak_age_ms(self) -> float | None:
        """Mean of the ages just before each delivery; None with fewer than two."""
        return self._peaks_ns / (self._teeth - 1) / 1e6 if self._teeth > 1 else None

    def _tooth(self, until_ns: int) -> int:
        """Twice the area under the current tooth."""
        length = until_ns - self._delivered_ns
        return length * (2 * (self._delivered_ns - self._generated_ns) + length)


def _time_average_ms(saw: Sawtooth, changes_ns: Instants, weights: NDArray[np.float64]) -> float | None:
    """Time average of the age times a piecewise constant weight; arguments as in ``urgency_ms``."""
    if not len(saw.delivered_ns) or saw.end_ns <= saw.delivered_ns[0]:
        return None
    starts, born = saw.delivered_ns, saw.generated_ns
    if len(changes_ns):
        more = changes_ns[(changes_ns > starts[0]) & (changes_ns < saw.end_ns)]
        starts = np.unique(np.concatenate((starts, more)))
        born = newest_at(saw, starts)
    weight = weights[np.searchsorted(changes_ns, starts, side="right")]
    # Integers are subtracted first, because float64 would lose nanoseconds of absolute time.
    floor, length = (starts - born).astype(float), np.diff(np.append(starts, saw.end_ns)).astype(float)
    return float((weight * length * (floor + length / 2)).sum() / length.sum() / 1e6)
