"""Forward and backward recursions of ``hmm``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit


@njit(cache=True)
def log_likelihood(initial, steps, emissions):
    """log p(all observations). initial (M,): the state before the first step; steps (N, M, M): step ``k``
    leads from observation k-1 to k; emissions (N, M): likelihood of observation k in each state.

    -inf where the observations are impossible.
    """
    n, m = emissions.shape
    at = initial.copy()
    nxt = np.empty(m)
    total = 0.0
    for k in range(n):
        mass = 0.0
        for j in range(m):
            value = 0.0
            for i in range(m):
                value += at[i] * steps[k, i, j]
            nxt[j] = value * emissions[k, j]
            mass += nxt[j]
        if not mass > 0.0:
            return -math.inf
        total += math.log(mass)
        for j in range(m):
            at[j] = nxt[j] / mass
    return total


@njit(cache=True)
def smooth(initial, steps, emissions):
    """Log likelihood, and weights (N, M, M) such that ``weights[k, i, j] * steps[k, i, j]`` is the
    probability, given everything, of state i at observation k-1 and j at k.

    Baum, Petrie, Soules and Weiss 1970, with the scaling of Rabiner, Proc. IEEE 77(2), 1989.
    """
    n, m = emissions.shape
    before = np.empty((n, m))  # the filtered state just before each step
    mass = np.empty(n)
    at = initial.copy()
    nxt = np.empty(m)
    total = 0.0
    for k in range(n):
        sum_ = 0.0
        for j in range(m):
            before[k, j] = at[j]
        for j in range(m):
            value = 0.0
            for i in range(m):
                value += at[i] * steps[k, i, j]
            nxt[j] = value * emissions[k, j]
            sum_ += nxt[j]
        mass[k] = sum_
        if not sum_ > 0.0:
            return -math.inf, np.zeros((n, m, m))
        total += math.log(sum_)
        for j in range(m):
            at[j] = nxt[j] / sum_
    weights = np.empty((n, m, m))
    after = np.ones(m)  # p(what follows | state), scaled
    for k in range(n - 1, -1, -1):
        for i in range(m):
            for j in range(m):
                weights[k, i, j] = before[k, i] * emissions[k, j] * after[j] / mass[k]
        for i in range(m):
            value = 0.0
            for j in range(m):
                value += steps[k, i, j] * emissions[k, j] * after[j]
            nxt[i] = value / mass[k]
        for i in range(m):
            after[i] = nxt[i]
    return total, weights
