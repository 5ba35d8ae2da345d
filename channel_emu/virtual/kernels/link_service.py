"""One link under each discipline: the decisions of ``link.Link``, over whole arrays.

The hot loops pass no arrays to functions: numba counts references at each call, which costs more than a
decision.
"""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numba import njit

from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.virtual.kernels.chain_path import completion_ns, saturating_add, saturating_round

# Outcomes, as in link_run.OUTCOMES.
IN_FLIGHT, DELIVERED, DROPPED_BUSY, SUPERSEDED, SKIPPED = 0, 1, 2, 3, 4
DROP_NEW, NEWEST_WAITS, FCFS, LCFS_PREEMPT, PARALLEL = 0, 1, 2, 3, 4


@njit(cache=True, nogil=True)
def speeds_per_ns(means_ms):
    """Work served in a nanosecond by state: the inverse of the mean delay, inf where that is 0."""
    speeds = np.empty(len(means_ms))
    for i in range(len(means_ms)):
        speeds[i] = 1.0 / (means_ms[i] * 1e6) if means_ms[i] > 0.0 else np.inf
    return speeds


@njit(cache=True, nogil=True)
def serve(
    arrive_ns, discipline, queue_limit, work, means_ms, modulated, starts, states, horizon_ns
):  # fmt: skip
    """Outcome int8, started and due int64 ns (-1: never) of each frame, each (n,).

    arrive_ns: int64 (n,), ascending where not -1 (skipped).
    discipline: index into ``link.DISCIPLINES``.
    queue_limit: most frames waiting (fcfs) or in service (parallel).
    work: (n,) of ``work.draw``.
    means_ms: mean delay, (1,) or one a state.
    modulated: the work is served at the rate of each state passed through, not of the first one.
    starts, states: the chain's path, see ``chain_path``.
    horizon_ns: frames due later are in flight.
    """
    count = len(arrive_ns)
    outcome = np.zeros(count, np.int8)
    started = np.full(count, -1, np.int64)
    due = np.full(count, -1, np.int64)
    speeds = speeds_per_ns(means_ms)
    by_state = len(means_ms) > 1
    mean_ms = means_ms[0]
    hint = 0
    if discipline == DROP_NEW:
        # The general loop below would decide the same; nothing waits here, which makes it twice as fast.
        free_ns = np.int64(0)
        for i in range(count):
            at_ns = arrive_ns[i]
            if at_ns < 0:
                outcome[i] = SKIPPED
            elif at_ns > horizon_ns:
                continue
            elif free_ns > at_ns:
                outcome[i] = DROPPED_BUSY
            else:
                while starts[hint + 1] <= at_ns:
                    hint += 1
                if modulated:
                    free_ns = completion_ns(work[i], speeds, starts, states, at_ns, hint)
                else:
                    if by_state:
                        mean_ms = means_ms[states[hint]]
                    free_ns = saturating_add(at_ns, saturating_round(work[i] * mean_ms * 1e6))
                started[i], due[i] = at_ns, free_ns
                if free_ns <= horizon_ns:
                    outcome[i] = DELIVERED
        return outcome, started, due
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
        while starts[hint + 1] <= at_ns:
            hint += 1
        if modulated:
            end_ns = completion_ns(work[frame], speeds, starts, states, at_ns, hint)
        else:
            if by_state:
                mean_ms = means_ms[states[hint]]
            end_ns = saturating_add(at_ns, saturating_round(work[frame] * mean_ms * 1e6))
        started[frame], due[frame] = at_ns, end_ns
        serving, free_ns = frame, end_ns
        if discipline == PARALLEL:
            heappush(busy, end_ns)
    for i in range(count):
        if outcome[i] == IN_FLIGHT and 0 <= due[i] <= horizon_ns:
            outcome[i] = DELIVERED
    return outcome, started, due
