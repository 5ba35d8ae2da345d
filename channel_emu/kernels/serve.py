"""Service of one link's arrivals under each discipline: what ``link.Link`` decides, over whole arrays."""

from __future__ import annotations

import math
from heapq import heappop, heappush

import numpy as np
from numba import njit

from channel_emu.instants import NEVER_NS
from channel_emu.kernels.path import later, saturate, segment, spend
from channel_emu.kernels.philox import exponential, pair

# Outcomes, as in simulate.OUTCOMES.
IN_FLIGHT, DELIVERED, DROPPED_BUSY, SUPERSEDED, SKIPPED = 0, 1, 2, 3, 4
DROP_NEW, NEWEST_WAITS, FCFS, LCFS_PREEMPT, PARALLEL = 0, 1, 2, 3, 4
LAW_NONE, LAW_EXPONENTIAL, LAW_DETERMINISTIC, LAW_GAMMA, LAW_LOGNORMAL, LAW_TRACE = 0, 1, 2, 3, 4, 5


@njit(cache=True)
def _normal(u, v):
    return math.sqrt(-2.0 * math.log(u)) * math.cos(2.0 * math.pi * v)


@njit(cache=True)
def _work(number, law, parameter, delays_ms, key):
    if law == LAW_EXPONENTIAL:
        return exponential(number, key)
    if law == LAW_LOGNORMAL:
        u, v = pair(number, 0, key)
        return math.exp(parameter * _normal(u, v) - parameter * parameter / 2)
    if law == LAW_TRACE:
        return delays_ms[number % len(delays_ms)]
    if law == LAW_GAMMA:
        boosted = parameter if parameter >= 1.0 else parameter + 1.0
        d = boosted - 1.0 / 3.0
        c = 1.0 / math.sqrt(9.0 * d)
        again = 1
        while True:
            a, b = pair(number, again, key)
            x = _normal(a, b)
            v = (1.0 + c * x) ** 3
            u = pair(number, again + 1, key)[0]
            if v > 0.0 and math.log(u) < 0.5 * x * x + d - d * v + d * math.log(v):
                break
            again += 2
        value = d * v
        if parameter < 1.0:
            value *= pair(number, 0, key)[0] ** (1.0 / parameter)
        return value / parameter
    return 1.0


@njit(cache=True)
def serve(
    arrive_ns, discipline, queue_limit, law, parameter, delays_ms, means_ms, modulated, starts, states, key,
    horizon_ns,
):  # fmt: skip
    """Outcome int8, started and due int64 (-1: never) of each frame.

    arrive_ns: int64 (n,), ascending where not -1 (skipped). means_ms: (1,) or one a state. starts, states:
    the chain's path. Frames due after the horizon are in flight.
    """
    count = len(arrive_ns)
    outcome = np.zeros(count, np.int8)
    started = np.full(count, -1, np.int64)
    due = np.full(count, -1, np.int64)
    speeds = np.empty(len(means_ms))
    for i in range(len(means_ms)):
        speeds[i] = 1.0 / (means_ms[i] * 1e6) if means_ms[i] > 0.0 else np.inf
    hint = 0
    free_ns = np.int64(0)  # when the server is free; a completion at the very instant comes first
    serving = -1
    waiting = -1
    busy = [np.int64(0)]  # parallel: heap of due instants
    busy.pop()
    head = 0  # fcfs: queue[head:tail] wait
    tail = 0
    queue = np.empty(count if discipline == FCFS else 1, np.int64)
    n = 0
    while True:
        # The next thing to start, and when: a waiting frame as the server falls free, or the next arrival.
        at_ns, frame = NEVER_NS, -1
        if discipline == NEWEST_WAITS and waiting >= 0:
            at_ns, frame = free_ns, waiting
        elif discipline == FCFS and head < tail:
            at_ns, frame = free_ns, queue[head]
        while n < count and arrive_ns[n] < 0:
            outcome[n] = SKIPPED
            n += 1
        if n < count and arrive_ns[n] < at_ns:
            at_ns, frame = arrive_ns[n], n
        if frame < 0 or at_ns > horizon_ns:
            break
        if frame == n:
            n += 1
            if discipline == PARALLEL:
                while len(busy) > 0 and busy[0] <= at_ns:
                    heappop(busy)
                if len(busy) >= queue_limit:
                    outcome[frame] = DROPPED_BUSY
                    continue
            elif free_ns > at_ns:
                if discipline == DROP_NEW:
                    outcome[frame] = DROPPED_BUSY
                    continue
                if discipline == NEWEST_WAITS:
                    if waiting >= 0:
                        outcome[waiting] = SUPERSEDED
                    waiting = frame
                    continue
                if discipline == FCFS:
                    if tail - head >= queue_limit:
                        outcome[frame] = DROPPED_BUSY
                    else:
                        queue[tail] = frame
                        tail += 1
                    continue
                outcome[serving] = SUPERSEDED
        elif discipline == FCFS:
            head += 1
        else:
            waiting = -1
        hint = segment(starts, at_ns, hint)
        work = 0.0 if law == LAW_NONE else _work(frame, law, parameter, delays_ms, key)
        if law == LAW_NONE:
            end_ns = at_ns
        elif modulated:
            end_ns = spend(work, speeds, starts, states, at_ns, hint)
        else:
            mean = means_ms[states[hint]] if len(means_ms) > 1 else means_ms[0]
            end_ns = later(at_ns, saturate(work * mean * 1e6))
        started[frame], due[frame] = at_ns, end_ns
        serving, free_ns = frame, end_ns
        if discipline == PARALLEL:
            heappush(busy, end_ns)
    for i in range(count):
        if outcome[i] == IN_FLIGHT and 0 <= due[i] <= horizon_ns:
            outcome[i] = DELIVERED
    return outcome, started, due
