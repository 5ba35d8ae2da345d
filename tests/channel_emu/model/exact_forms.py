"""Average age of information in closed form, for the systems the links can be. Rates per ms, ages in ms.

Sources: Kaul, Yates and Gruteser (INFOCOM 2012); Costa, Codreanu and Ephremides (IEEE T-IT 62(4), 2016) for
one waiting place; Yates and Kaul (IEEE T-IT 65(3), 2019) for preemption by several sources; the drop-new,
shared and modulated forms are derived where they stand, by renewal arguments.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.linalg import expm


def mm1_fcfs(lam: float, mu: float) -> float:
    rho = lam / mu
    return (1 + 1 / rho + rho**2 / (1 - rho)) / mu


def mm1_newest_waits(lam: float, mu: float) -> float:
    both = lam**2 + lam * mu + mu**2
    return 1 / lam + 2 / mu + lam / (lam + mu) ** 2 + 1 / (lam + mu) - 2 * (lam + mu) / both


def mg1_preemptive(lam: float, shape: float, mean: float) -> float:
    """1 / (lambda E[e^(-lambda S)]) for gamma service."""
    return (1 + lam * mean / shape) ** shape / lam


def dg1_drop_new(period: float, mean: float, survival: Callable[[np.ndarray], np.ndarray]) -> tuple[float, float]:
    """Mean and peak age; survival(t) = P(S > t) of an array. E[K], E[K²] are sums of P(K > k) = P(S > kC)."""
    above = survival(period * np.arange(2000))
    first, second = above.sum(), ((2 * np.arange(2000) + 1) * above).sum()
    return mean + period * second / (2 * first), mean + period * first


def shared_mm1_preemptive(lam: float, other: float, mean: float, _second_moment: float) -> float:
    return (1 + (lam + other) * mean) / lam


def shared_mg1_blocking(lam: float, other: float, mean: float, second_moment: float) -> float:
    """A source's deliveries are N server cycles S + X apart, N geometric of mean 1 + other/lam."""
    rate = lam + other
    cycle, variation = mean + 1 / rate, second_moment - mean**2 + 1 / rate**2
    p = lam / rate
    apart = cycle / p
    variance = variation / p + (1 - p) / p**2 * cycle**2
    return mean + (variance + apart**2) / (2 * apart)


def dm1_parallel(period: float, mu: float) -> float:
    """No server limit: the age is that of the youngest frame that has arrived. Summed over the frames, from
    the youngest on, and averaged over the phase of the period."""
    phases = (np.arange(2000) + 0.5) / 2000 * period
    ages = phases[:, None] + period * np.arange(400)  # of the youngest, second youngest, ... frame
    arrived = -np.expm1(-mu * ages)
    none_younger = np.cumprod(np.concatenate((np.ones((2000, 1)), 1 - arrived[:, :-1]), 1), 1)
    return float((none_younger * arrived * ages).sum(1).mean())


def modulated_drop_new(a: float, b: float, mu_good: float, mu_bad: float, period: float) -> float:
    """Gilbert-Elliott-modulated exponential service, periodic arrivals, drop-new. a: good to bad, b: back.

    T = Q - diag(mu), A = e^(QC), B = e^(TC), R = (I - B)^-1, m = (-T)^-1 1; alpha = alpha R (A - B) is the
    state at the start of service; E[K] = alpha R 1, E[K²] = alpha (I + B) R² 1;
    age = [C² E[K²] / 2 + C alpha R² (A - B) m] / (C E[K]).
    """
    q = np.array([[-a, a], [b, -b]])
    t = q - np.diag([mu_good, mu_bad])
    big_a, big_b, one, eye = expm(q * period), expm(t * period), np.ones(2), np.eye(2)
    r = np.linalg.inv(eye - big_b)
    m = np.linalg.inv(-t) @ one
    alpha = _stationary(r @ (big_a - big_b))
    mean = alpha @ r @ one
    square = alpha @ (eye + big_b) @ r @ r @ one
    return float((period**2 * square / 2 + period * (alpha @ r @ r @ (big_a - big_b) @ m)) / (period * mean))


def gilbert_elliott(a: float, b: float, loss: tuple[float, float], period: float, delay: float) -> tuple[float, float]:
    """Mean and peak age of periodic frames that each take ``delay``, lost with the probability of the state.

    N frames from one delivery to the next: with P the chain's change over a period, F = P diag(loss) and
    G = P diag(1 - loss), alpha = alpha (I - F)^-1 G is the state at a delivery; E[N] = alpha (I - F)^-1 1,
    E[N²] = alpha (I + F) (I - F)^-2 1. Age: delay + C E[N²] / (2 E[N]); peak: delay + C E[N].
    """
    p = expm(np.array([[-a, a], [b, -b]]) * period)
    f, g = p * np.array(loss), p * (1 - np.array(loss))
    r = np.linalg.inv(np.eye(2) - f)
    alpha = _stationary(r @ g)
    first, second = alpha @ r @ np.ones(2), alpha @ (np.eye(2) + f) @ r @ r @ np.ones(2)
    return delay + period * second / (2 * first), delay + period * first


def _stationary(transition: np.ndarray) -> np.ndarray:
    values, vectors = np.linalg.eig(transition.T)
    alpha = np.real(vectors[:, np.argmin(abs(values - 1))])
    return alpha / alpha.sum()
