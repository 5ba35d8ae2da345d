"""Exact mean age with periodic arrivals under drop-new (thesis 5.2 to 5.5).

Renewal argument over periods: a frame that starts in state i occupies the link for K periods, then the next
one starts; from its delivery to the next one, the age is the frame's delay plus the time since its delivery.
The tests compare the link with this; ``slot_ms`` shows the bias of sampling the chain at slot boundaries.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.chain import check_generator, transition_matrix


def drop_new_age_ms(
    generator_per_ms: NDArray[np.float64], means_ms: NDArray[np.float64], period_ms: float, slot_ms: float | None = None
) -> float:
    """Time average of the age in ms: exponential service modulated by the chain, one frame every period.

    generator_per_ms: (M, M), in 1/ms. M = 1 is the plain D/M/1/0 queue, with 1/mu + (C/2) coth(mu C/2).
    means_ms: (M,), mean delay while in each state.
    period_ms: C, the time between two frames.
    slot_ms: the chain's state is drawn at multiples of it and kept in between; None: continuous time.
    Raises ValueError for an invalid generator, or if the period is not a whole number of slots.

    Let A be the chain's transition matrix over a period, B the part of it with the service unfinished,
    R = (I - B)^-1, m the mean service time by state, and alpha = alpha R (A - B) the state in which a service
    starts. Then E[K] = alpha R 1, E[K²] = alpha (I + B) R² 1 and
    age = [C² E[K²]/2 + C alpha R² (A - B) m] / (C E[K]).
    """
    q = check_generator(generator_per_ms)
    rates = 1.0 / np.asarray(means_ms, float)
    one, eye = np.ones(len(q)), np.eye(len(q))
    if slot_ms is None:
        unfinished = _unfinished(q, rates, period_ms)
        after = transition_matrix(q, period_ms)
        mean_ms = np.linalg.solve(np.diag(rates) - q, one)
    else:
        slots = round(period_ms / slot_ms)
        if slots < 1 or abs(slots * slot_ms - period_ms) > 1e-9 * period_ms:
            raise ValueError(f"slot_ms: expected a whole number of slots in {period_ms:g} ms, got {slot_ms:g}")
        step = transition_matrix(q, slot_ms)
        through = np.exp(-rates * slot_ms)[:, None] * step
        unfinished = np.linalg.matrix_power(through, slots)
        after = np.linalg.matrix_power(step, slots)
        mean_ms = np.linalg.solve(eye - through, -np.expm1(-rates * slot_ms) / rates)
    r = np.linalg.inv(eye - unfinished)
    finished = after - unfinished
    alpha = _stationary(r @ finished)
    mean_k = alpha @ r @ one
    mean_k2 = alpha @ (eye + unfinished) @ r @ r @ one
    return float((period_ms * mean_k2 / 2 + alpha @ r @ r @ finished @ mean_ms) / mean_k)


def _unfinished(q: NDArray[np.float64], rates: NDArray[np.float64], span_ms: float) -> NDArray[np.float64]:
    """Transition probabilities (M, M) over ``span_ms`` with the service unfinished, computed with an
    additional, absorbing state for the finished service."""
    with_end = np.zeros((len(q) + 1, len(q) + 1))
    with_end[:-1, :-1] = q - np.diag(rates)
    with_end[:-1, -1] = rates
    return transition_matrix(with_end, span_ms)[:-1, :-1]


def _stationary(stochastic: NDArray[np.float64]) -> NDArray[np.float64]:
    """The stationary distribution of a stochastic matrix (M, M)."""
    size = len(stochastic)
    system = np.vstack((stochastic.T - np.eye(size), np.ones(size)))
    return np.linalg.lstsq(system, np.append(np.zeros(size), 1.0), rcond=None)[0]
