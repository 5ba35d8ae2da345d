"""Mean and peak age of information, from one link's deliveries over time (thesis 5.1 to 5.6)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.nanoseconds import to_ns

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
    if not len(saw.delivered_ns) or saw.end_ns <= saw.delivered_ns[0]:
        return None
    # Integers are subtracted first, because float64 would lose nanoseconds of absolute time.
    floor = (saw.delivered_ns - saw.generated_ns).astype(float)
    length = np.diff(np.append(saw.delivered_ns, saw.end_ns)).astype(float)
    return float((length * (floor + length / 2)).sum() / length.sum() / 1e6)


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


def peak_age_ms(saw: Sawtooth) -> float | None:
    """Mean of the ages just before each delivery; None with fewer than two."""
    if len(saw.delivered_ns) < 2:
        return None
    return float((saw.delivered_ns[1:] - saw.generated_ns[:-1]).mean() / 1e6)


def mean_of_known(values: list[float | None]) -> float | None:
    """Mean of the values that are not None, one a camera or link; None if there are none."""
    known = [value for value in values if value is not None]
    return float(np.mean(known)) if known else None


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
