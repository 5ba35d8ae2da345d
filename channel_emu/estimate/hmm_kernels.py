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
    """Probability (N, M) of each state at each observation, given all of them; 0 where they are impossible.

    Baum, Petrie, Soules and Weiss 1970, with the scaling of Rabiner, Proc. IEEE 77(2), 1989.
    """
    n, m = emissions.shape
    total, before, mass = forward(initial, steps, emissions)
    states = np.zeros((n, m))
    if total == -math.inf:
        return states
    after = np.ones(m)  # p(what follows | state), scaled
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
