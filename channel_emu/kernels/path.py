"""The chain's path over a whole horizon, and work spent along it: ``chain.Chain`` and ``traffic.spend``."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from channel_emu.instants import NEVER_NS
from channel_emu.kernels.philox import exponential, pair

_NEVER = float(NEVER_NS)


@njit(cache=True)
def saturate(span_ns):
    return NEVER_NS if span_ns >= _NEVER else np.int64(span_ns + 0.5)


@njit(cache=True)
def later(instant_ns, span_ns):
    return min(instant_ns + span_ns, NEVER_NS)


@njit(cache=True)
def chain_path(rates_per_ms, jumps, key, initial, horizon_ns):
    """Sojourns up to the first that ends after the horizon: starts int64 (S + 1,) ending with that end, and
    states int64 (S,). ``jumps``: cumulative jump probabilities (M, M)."""
    starts = np.empty(1024, np.int64)
    states = np.empty(1024, np.int64)
    starts[0], states[0] = 0, initial
    count = 0
    while True:
        state = states[count]
        rate = rates_per_ms[state]
        u, v = pair(count, 0, key)
        end = NEVER_NS if rate == 0.0 else later(starts[count], saturate(-math.log(u) / rate * 1e6))
        count += 1
        if count + 1 >= len(starts):
            starts = np.concatenate((starts, np.empty_like(starts)))
            states = np.concatenate((states, np.empty_like(states)))
        starts[count] = end
        if end > horizon_ns:
            return starts[: count + 1].copy(), states[:count].copy()
        states[count] = np.searchsorted(jumps[state], v, side="right")


@njit(cache=True)
def segment(starts, at_ns, hint):
    """Index of the sojourn that contains ``at_ns``, searched forwards from ``hint``, backwards if it must."""
    i = hint
    if starts[i] > at_ns:
        return np.searchsorted(starts, at_ns, side="right") - 1
    while i + 1 < len(starts) and starts[i + 1] <= at_ns:
        i += 1
    return i


@njit(cache=True)
def spend(work, rates_per_ns, starts, states, start_ns, hint):
    """Instant at which ``work`` is used up; NEVER_NS if not before the path's end."""
    alike = True
    for k in range(1, len(rates_per_ns)):
        alike &= rates_per_ns[k] == rates_per_ns[0]
    if alike:
        rate = rates_per_ns[0]
        return later(start_ns, saturate(work / rate)) if rate > 0.0 else NEVER_NS
    at_ns = start_ns
    i = segment(starts, at_ns, hint)
    while i < len(states):
        until_ns = starts[i + 1]
        rate = rates_per_ns[states[i]]
        if rate > 0.0:
            left = float(until_ns - at_ns)
            need = work / rate
            if need <= left:
                return later(at_ns, saturate(need))
            work -= rate * left
        at_ns = until_ns
        i += 1
    return NEVER_NS


@njit(cache=True)
def poisson_arrivals(rates_per_ns, starts, states, key, horizon_ns):
    """Instants of a (Markov-modulated) Poisson process in [0, horizon], int64."""
    found = np.empty(1024, np.int64)
    count, at_ns, hint = 0, 0, 0
    while True:
        hint = segment(starts, at_ns, hint)
        at_ns = spend(exponential(count, key), rates_per_ns, starts, states, at_ns, hint)
        if at_ns > horizon_ns:
            return found[:count].copy()
        if count == len(found):
            found = np.concatenate((found, np.empty_like(found)))
        found[count] = at_ns
        count += 1


@njit(cache=True)
def sample_newest(offered_ns, rates_per_ns, starts, states, key):
    """For each offered frame the arrival that samples it, or -1 where a newer frame was offered first."""
    sampled = np.empty(len(offered_ns), np.int64)
    hint = 0
    for n in range(len(offered_ns)):
        hint = segment(starts, offered_ns[n], hint)
        at_ns = spend(exponential(n, key), rates_per_ns, starts, states, offered_ns[n], hint)
        skipped = n + 1 < len(offered_ns) and at_ns > offered_ns[n + 1]
        sampled[n] = -1 if skipped else at_ns
    return sampled
