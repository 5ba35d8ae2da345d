"""Age of information from what was delivered when (thesis 5.1 to 5.6).

Two averages, never mixed: ``mean_age_ms`` is the continuous time average, the integral of the sawtooth over
its length; ``mean_age_slotted_ms`` samples the sawtooth at slot boundaries just after deliveries, as (5.2)
does, and is therefore about half a slot lower for a sawtooth that falls on the boundaries.
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
    """From all deliveries in any order: late ones that bring nothing newer do not change the age (5.4)."""
    order = np.argsort(delivered_ns, kind="stable")
    due, born = delivered_ns[order], generated_ns[order]
    newest = np.maximum.accumulate(born) if len(born) else born
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


def ages_at(saw: Sawtooth, at_ns: Instants) -> NDArray[np.float64]:
    """Age in ms at any instants (T,) (5.5); NaN before the first delivery."""
    at = np.asarray(at_ns, np.int64)
    if not len(saw.delivered_ns):
        return np.full(at.shape, np.nan)
    k = np.searchsorted(saw.delivered_ns, at, side="right") - 1
    return np.where(k >= 0, (at - saw.generated_ns[np.maximum(k, 0)]) / 1e6, np.nan)


def _teeth(saw: Sawtooth) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Age at the foot and length of each tooth, in ns. Differences first, in integers: float64 would lose
    nanoseconds of absolute time."""
    edges = np.append(saw.delivered_ns, saw.end_ns)
    return (saw.delivered_ns - saw.generated_ns).astype(float), np.diff(edges).astype(float)
