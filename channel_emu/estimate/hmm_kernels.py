"""Likelihoods of spans and events, and the forward and backward recursions of ``hmm``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def propagate(eigenvalues, p_slow, p_fast, span_ms, waiting):
    """exp(G u) (N, 2, 2) for each span u.

    eigenvalues: (W, 3), slow, fast and half of their distance, by number of waiting cameras.
    p_slow, p_fast: (W, 2, 2), see ``hmm._Propagator``.
    span_ms: (N,). waiting: (N,), number of waiting cameras, which selects G.
    """
    out = np.empty((len(span_ms), 2, 2))
    for k in range(len(span_ms)):
        w, u = waiting[k], span_ms[k]
        slow, fast = math.exp(eigenvalues[w, 0] * u), math.exp(eigenvalues[w, 1] * u)
        apart = -math.expm1(-2.0 * eigenvalues[w, 2] * u)
        for i in range(2):
            out[k, i, i] = slow * p_slow[w, i, i] + fast * p_fast[w, i, i]
            out[k, i, 1 - i] = slow * apart * p_slow[w, i, 1 - i]
    return out


@njit(cache=True)
def emit(mean_ms, rate_per_ms, delay_ms, arrived):
    """Likelihood (N, 2) of each event by state, with rows scaled to a maximum of 1, and the sum of the
    scales' logarithms.

    mean_ms, rate_per_ms: (2,) by state; NaN if not part of the model.
    delay_ms, arrived: (N,), see ``hmm.Timeline``.
    """
    delays, rates = not np.isnan(mean_ms[0]), not np.isnan(rate_per_ms[0])
    log_mean, log_rate = np.log(mean_ms), np.log(rate_per_ms)
    out, total = np.empty((len(delay_ms), 2)), 0.0
    for k in range(len(delay_ms)):
        a = b = 0.0
        if delays and not math.isnan(delay_ms[k]):
            a -= log_mean[0] + delay_ms[k] / mean_ms[0]
            b -= log_mean[1] + delay_ms[k] / mean_ms[1]
        if rates and arrived[k]:
            a += log_rate[0]
            b += log_rate[1]
        scale = max(a, b)
        out[k, 0], out[k, 1] = math.exp(a - scale), math.exp(b - scale)
        total += scale
    return out, total


@njit(cache=True)
def forward(initial, steps, emissions):
    """The forward recursion.

    initial: (M,), distribution of the state before the first step.
    steps: (N, M, M); step k leads from observation k - 1 to k.
    emissions: (N, M), likelihood of observation k in each state.
    Returns log p(all observations), -inf if they are impossible; the filtered distribution before each step
    (N, M); and the probability of each observation given the earlier ones (N,).
    """
    n, m = emissions.shape
    before = np.empty((n, m))
    mass = np.empty(n)
    at = initial.copy()
    nxt = np.empty(m)
    total = 0.0
    for k in range(n):
        sum_ = 0.0
        for j in range(m):
            before[k, j] = at[j]
            value = 0.0
            for i in range(m):
                value += at[i] * steps[k, i, j]
            nxt[j] = value * emissions[k, j]
            sum_ += nxt[j]
        mass[k] = sum_
        if not sum_ > 0.0:
            return -math.inf, before, mass
        total += math.log(sum_)
        for j in range(m):
            at[j] = nxt[j] / sum_
    return total, before, mass


@njit(cache=True)
def smooth(initial, steps, emissions):
    """Probability (N, M) of each state at each observation, given all observations; 0 if these are
    impossible.

    Arguments as in ``forward``. Baum, Petrie, Soules and Weiss 1970, with the scaling of Rabiner, Proc. IEEE
    77(2), 1989.
    """
    n, m = emissions.shape
    total, before, mass = forward(initial, steps, emissions)
    states = np.zeros((n, m))
    if total == -math.inf:
        return states
    after = np.ones(m)  # p(later observations | state), scaled
    nxt = np.empty(m)
    for k in range(n - 1, -1, -1):
        nxt[:] = 0.0
        for i in range(m):
            for j in range(m):
                value = steps[k, i, j] * emissions[k, j] * after[j] / mass[k]
                states[k, j] += before[k, i] * value
                nxt[i] += value
        after[:] = nxt
    return states
