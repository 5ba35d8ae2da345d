"""Metrics of age, each a function of one sample path: what was delivered when (thesis 5.1 to 5.6).

``METRICS`` has them by the name that people type; ``measure`` reads such a spelling.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.spelling import SpellingError, span_ms

Instants = NDArray[np.int64]


@dataclass(frozen=True)
class Sawtooth:
    """Deliveries that made the receiver's newest frame newer: instants and generation times, int64 ns (K,).

    From ``delivered_ns[k]`` on the age is ``t - generated_ns[k]``, up to the next delivery or ``end_ns``.
    """

    delivered_ns: Instants
    generated_ns: Instants
    end_ns: int


def sawtooth(delivered_ns: Instants, generated_ns: Instants, end_ns: int) -> Sawtooth:
    """From all deliveries in any order; a delivery of an older frame does not change the age (5.4)."""
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
    """Continuous time average from the first delivery to the end; None where nothing arrived."""
    if not len(saw.delivered_ns) or saw.end_ns <= saw.delivered_ns[0]:
        return None
    # Integers are subtracted first, because float64 would lose nanoseconds of absolute time.
    floor = (saw.delivered_ns - saw.generated_ns).astype(float)
    length = np.diff(np.append(saw.delivered_ns, saw.end_ns)).astype(float)
    return float((length * (floor + length / 2)).sum() / length.sum() / 1e6)


def query_age_ms(saw: Sawtooth, every_ms: float) -> float | None:
    """Mean of the age at multiples of ``every_ms``, just after deliveries, from the first delivery to the
    end: the age that queries meet, or at slot boundaries (5.2). Deliveries that fall on them lower it by half
    of ``every_ms``."""
    every_ns = round(every_ms * 1e6)
    if every_ns < 1:
        raise ValueError(f"queries: expected at least a nanosecond apart, got {every_ms:g} ms")
    edges = np.append(saw.delivered_ns, saw.end_ns)
    first = -(-edges // every_ns)  # the first instant at or after each delivery
    count = np.diff(first).astype(float)
    if not len(count) or count.sum() == 0:
        return None
    start = (first[:-1] * every_ns - saw.generated_ns).astype(float)
    return float((count * start + every_ns * count * (count - 1) / 2).sum() / count.sum() / 1e6)


def shown_age_ms(saw: Sawtooth, computing_ms: float, refresh_ms: float) -> float | None:
    """Age of what is shown: each frame is computed on for ``computing_ms`` after its delivery, and a screen
    shows the newest one that is ready at each multiple of ``refresh_ms``, until the next."""
    ready = Sawtooth(saw.delivered_ns + round(computing_ms * 1e6), saw.generated_ns, saw.end_ns)
    at_refresh = query_age_ms(ready, refresh_ms)
    return None if at_refresh is None else at_refresh + refresh_ms / 2


def peak_age_ms(saw: Sawtooth) -> float | None:
    """Mean of the ages just before each delivery; None with fewer than two."""
    if len(saw.delivered_ns) < 2:
        return None
    return float((saw.delivered_ns[1:] - saw.generated_ns[:-1]).mean() / 1e6)


def newest_at(saw: Sawtooth, at_ns: Instants) -> Instants:
    """When the newest frame delivered by each instant (T,) was generated, int64 ns; -1 before the first."""
    if not len(saw.delivered_ns):
        return np.full(np.shape(at_ns), -1, np.int64)
    k = np.searchsorted(saw.delivered_ns, at_ns, side="right") - 1
    return np.where(k >= 0, saw.generated_ns[np.maximum(k, 0)], -1)


def mean_of_known(values: list[float | None]) -> float | None:
    """Over cameras or links; None where none has a value."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


class Metric(NamedTuple):
    """about: one line, with what follows the name. values: readers of what follows. of: the metric, given a
    path and these values."""

    about: str
    values: tuple[Callable[[str], float], ...]
    of: Callable[..., float | None]


METRICS = {
    "age": Metric("time average of the age", (), mean_age_ms),
    "peak": Metric("age just before a delivery", (), peak_age_ms),
    "query": Metric("age at regular queries, query:100ms", (span_ms,), query_age_ms),
    "shown": Metric(
        "age of what a screen shows, by time of computing and interval of refreshes, shown:20ms:16.7ms",
        (span_ms, span_ms), shown_age_ms,
    ),
}  # fmt: skip


def measure(text: str, saw: Sawtooth) -> float | None:
    """A metric as people type it, in ms; None where nothing arrived. Raises SpellingError."""
    name, *words = text.split(":")
    if name not in METRICS:
        raise SpellingError(f"metric {text!r}: expected one of {', '.join(METRICS)}")
    metric = METRICS[name]
    try:
        values = [read(word) for read, word in zip(metric.values, words, strict=True)]
        return metric.of(saw, *values)
    except ValueError:
        raise SpellingError(f"metric {text!r}: {metric.about}") from None


class RunningAge:
    """``mean_age_ms`` and ``peak_age_ms`` of deliveries added in order of time, in constant memory."""

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
        """From the first delivery to ``end_ns``; None where nothing arrived."""
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
