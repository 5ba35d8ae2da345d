"""The chain's path over a whole run, and arrivals along it: kernels of ``chain.Chain`` and ``traffic``.

Common arguments:

    starts, states   the chain's path: starts of the sojourns and the end of the last, int64 ns (S + 1,), and
                     their states (S,)
    rates_per_ns     float64, one entry a state, or one for all
    work             value that the integral of the rate must reach
    key              uint64 (2,), of a random stream (``counter_rng.stream_key``)
    hint             index of the sojourn at which a search starts
    horizon_ns       end of the run
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from channel_emu.model import nanoseconds
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.virtual.kernels.philox import fill

_NEVER = float(NEVER_NS)
# Random numbers are drawn in blocks that amortize the call and fit into the L1 cache.
_BLOCK = 256


saturating_round = njit(nanoseconds.saturating_round, nogil=True)
saturating_add = njit(nanoseconds.saturating_add, nogil=True)


@njit(cache=True, nogil=True)
def chain_path(sojourn_rate, jumps, slot_ns, key, initial, horizon_ns):
    """The path (starts, states) up to the first sojourn that ends after the horizon.

    sojourn_rate: (M,). jumps: (M, M). These, slot_ns and initial are attributes of ``chain.Chain``.
    """
    starts = np.empty(1024, np.int64)
    states = np.empty(1024, np.int64)
    starts[0], states[0] = 0, initial
    u, v = np.empty(_BLOCK), np.empty(_BLOCK)
    count = 0
    while True:
        state = states[count]
        k = count % _BLOCK
        if k == 0:
            fill(count, u, v, key)
        end = NEVER_NS
        if sojourn_rate[state] != 0.0:
            if slot_ns == 0:
                end = saturating_add(starts[count], saturating_round(-math.log(u[k]) / sojourn_rate[state] * 1e6))
            else:
                slots = math.log(u[k]) / sojourn_rate[state]
                if slots * slot_ns < _NEVER:
                    end = saturating_add(starts[count], (np.int64(slots) + 1) * slot_ns)
        count += 1
        if count + 1 >= len(starts):
            starts = np.concatenate((starts, np.empty_like(starts)))
            states = np.concatenate((states, np.empty_like(states)))
        starts[count] = end
        if end > horizon_ns:
            return starts[: count + 1].copy(), states[:count].copy()
        states[count] = np.searchsorted(jumps[state], v[k], side="right")


@njit(cache=True, nogil=True)
def segment(starts, at_ns, hint):
    """Index of the sojourn that contains ``at_ns``: linear search forward from ``hint``, else binary
    search."""
    i = hint
    if starts[i] > at_ns:
        return np.searchsorted(starts, at_ns, side="right") - 1
    while i + 1 < len(starts) and starts[i + 1] <= at_ns:
        i += 1
    return i


@njit(cache=True, nogil=True)
def completion_ns(work, rates_per_ns, starts, states, start_ns, hint):
    """``traffic.completion_ns`` along the path; NEVER_NS if the work is not done before the path's end."""
    alike = True
    for k in range(1, len(rates_per_ns)):
        alike &= rates_per_ns[k] == rates_per_ns[0]
    if alike:
        rate = rates_per_ns[0]
        return saturating_add(start_ns, saturating_round(work / rate)) if rate > 0.0 else NEVER_NS
    at_ns = start_ns
    i = segment(starts, at_ns, hint)
    while i < len(states):
        until_ns = starts[i + 1]
        rate = rates_per_ns[states[i]]
        if rate > 0.0:
            left = float(until_ns - at_ns)
            need = work / rate
            if need <= left:
                return saturating_add(at_ns, saturating_round(need))
            work -= rate * left
        at_ns = until_ns
        i += 1
    return NEVER_NS


@njit(cache=True, nogil=True)
def poisson_arrivals(rates_per_ns, starts, states, key, horizon_ns):
    """Instants of a (Markov-modulated) Poisson process in [0, horizon], int64.

    ``completion_ns`` inlined: the same operations in the same order, without a call for each arrival.
    """
    found = np.empty(1024, np.int64)
    u, v = np.empty(_BLOCK), np.empty(_BLOCK)
    alike = True
    for k in range(1, len(rates_per_ns)):
        alike &= rates_per_ns[k] == rates_per_ns[0]
    count, at_ns, i = 0, np.int64(0), 0
    while True:
        k = count % _BLOCK
        if k == 0:
            fill(count, u, v, key)
        work = -math.log(u[k])
        if alike:
            at_ns = (
                saturating_add(at_ns, saturating_round(work / rates_per_ns[0])) if rates_per_ns[0] > 0.0 else NEVER_NS
            )
        else:
            while True:
                until_ns = starts[i + 1]
                rate = rates_per_ns[states[i]]
                if rate > 0.0:
                    left = float(until_ns - at_ns)
                    need = work / rate
                    if need <= left:
                        at_ns = saturating_add(at_ns, saturating_round(need))
                        break
                    work -= rate * left
                at_ns = until_ns
                i += 1
                if i == len(states):
                    at_ns = NEVER_NS
                    break
        if at_ns > horizon_ns:
            return found[:count].copy()
        if not alike:  # an instant rounded to the end of a sojourn belongs to the next one
            while starts[i + 1] <= at_ns:
                i += 1
        if count == len(found):
            found = np.concatenate((found, np.empty_like(found)))
        found[count] = at_ns
        count += 1


@njit(cache=True, nogil=True)
def sample_newest(offered_ns, rates_per_ns, starts, states, key):
    """Instant (n,) of the arrival that samples each offered frame, or -1 if a newer frame is offered first.

    offered_ns: int64 (n,), ascending.
    """
    sampled = np.empty(len(offered_ns), np.int64)
    u, v = np.empty(_BLOCK), np.empty(_BLOCK)
    hint = 0
    for n in range(len(offered_ns)):
        k = n % _BLOCK
        if k == 0:
            fill(n, u, v, key)
        hint = segment(starts, offered_ns[n], hint)
        at_ns = completion_ns(-math.log(u[k]), rates_per_ns, starts, states, offered_ns[n], hint)
        skipped = n + 1 < len(offered_ns) and at_ns > offered_ns[n + 1]
        sampled[n] = -1 if skipped else at_ns
    return sampled
