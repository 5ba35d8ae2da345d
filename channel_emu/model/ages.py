"""Age of information from what was delivered when (thesis 5.1 to 5.6).

Two averages: ``mean_age_ms`` is the continuous time average, the integral of the sawtooth over
its length; ``mean_age_slotted_ms`` samples the sawtooth at slot boundaries just after deliveries, as (5.2)
does, and is therefore about half a slot lower if deliveries fall on the boundaries.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
    floor, length = _teeth(saw)
    return float((length * (floor + length / 2)).sum() / length.sum() / 1e6)


def mean_age_slotted_ms(saw: Sawtooth, slot_ms: float = 1.0) -> float | None:
    """Mean of the age at the slot boundaries from the first delivery to the end (5.2)."""
    slot_ns = round(slot_ms * 1e6)
    edges = np.append(saw.delivered_ns, saw.end_ns)
    first = -(-edges // slot_ns)  # the first boundary at or after each delivery
    count = np.diff(first).astype(float)
    if not len(count) or count.sum() == 0:
        return None
    start = (first[:-1] * slot_ns - saw.generated_ns).astype(float)
    return float((count * start + slot_ns * count * (count - 1) / 2).sum() / count.sum() / 1e6)


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


def _teeth(saw: Sawtooth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Age at the start and length of each tooth, in ns. Integers are subtracted first, because float64 would
    lose nanoseconds of absolute time."""
    edges = np.append(saw.delivered_ns, saw.end_ns)
    return (saw.delivered_ns - saw.generated_ns).astype(float), np.diff(edges).astype(float)
