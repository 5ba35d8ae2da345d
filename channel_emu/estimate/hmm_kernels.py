"""Forward and backward recursions of ``hmm``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def forward(initial, steps, emissions):
    """The forward recursion: log p(all observations), and for each observation k the filtered state just
    before its step (N, M) and its probability given those before it (N,).

    initial (M,): the state before the first step; steps (N, M, M): step ``k`` leads from observation k-1 to
    k; emissions (N, M): likelihood of observation k in each state. -inf where observations are impossible.
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
    """Log likelihood, and weights (N, M, M) such that ``weights[k, i, j] * steps[k, i, j]`` is the
    probability, given everything, of state i at observation k-1 and j at k.

    Baum, Petrie, Soules and Weiss 1970, with the scaling of Rabiner, Proc. IEEE 77(2), 1989.
    """
    n, m = emissions.shape
    total, before, mass = forward(initial, steps, emissions)
    if total == -math.inf:
        return total, np.zeros((n, m, m))
    weights = np.empty((n, m, m))
    after = np.ones(m)  # p(what follows | state), scaled
    nxt = np.empty(m)
    for k in range(n - 1, -1, -1):
        for i in range(m):
            for j in range(m):
                weights[k, i, j] = before[k, i] * emissions[k, j] * after[j] / mass[k]
        for i in range(m):
            value = 0.0
            for j in range(m):
                value += steps[k, i, j] * emissions[k, j] * after[j]
            nxt[i] = value / mass[k]
        after[:] = nxt
    return total, weights
