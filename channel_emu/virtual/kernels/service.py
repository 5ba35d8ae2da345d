"""The decisions of ``queue_server.QueueServer`` and ``link.Link`` for all frames of one server."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numba import njit

from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.virtual.kernels.chain_path import completion_ns, saturating_add, saturating_round

# Outcomes, as in link_run.OUTCOMES.
IN_FLIGHT, DELIVERED, DROPPED_BUSY, SUPERSEDED, SKIPPED = 0, 1, 2, 3, 4
DROP_NEW, NEWEST_WAITS, FCFS, PARALLEL = 0, 1, 2, 4


@njit(cache=True, nogil=True)
def _longest_waiting(head, ticket):
    """The camera whose waiting frame is served next; at least one must wait."""
    best = -1
    for c in range(len(head)):
        if head[c] >= 0 and (best < 0 or ticket[head[c]] < ticket[head[best]]):
            best = c
    return best


@njit(cache=True, nogil=True)
def _drop_new(arrive_ns, work, means_ms, modulated, speeds, starts, states, horizon_ns, outcome, started, due):
    """``serve`` for one camera under drop-new; writes its results into the last three arguments."""
    by_state = len(means_ms) > 1
    mean_ms = means_ms[0]
    free_ns, hint = np.int64(0), 0
    for i in range(len(arrive_ns)):
        at_ns = arrive_ns[i]
        if at_ns > horizon_ns:
            return
        if at_ns < 0:
            outcome[i] = SKIPPED
            continue
        if free_ns > at_ns:
            outcome[i] = DROPPED_BUSY
            continue
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


@njit(cache=True, nogil=True)
def serve(
    arrive_ns,
    camera,
    discipline,
    queue_limit,
    work,
    means_ms,
    speeds,
    modulated,
    starts,
    states,
    path_from,
    path_to,
    horizon_ns,
):
    """Serve the n frames of all cameras, given in the order of their arrival.

    arrive_ns: int64 (n,); -1: never sampled.
    camera: (n,), index of the frame's camera.
    discipline: index into ``link.DISCIPLINES``.
    queue_limit: maximum number of frames waiting (fcfs) or in service (parallel).
    work: (n,), of ``work.draw``.
    means_ms: mean delay, (1,) or one a state. speeds: its inverse in 1/ns, inf for a mean of 0.
    modulated: serve the work at the rate of the current state, not of the state at the start.
    starts, states: concatenated paths of the chains (see ``chain_path``). Camera c's path is
        starts[path_from[c] : path_to[c]], and likewise in ``states``, whose last entry is unused.
    horizon_ns: frames due later are in flight.
    Returns outcome (int8), started and due (int64 ns, -1: never), each (n,).
    """
    count, cameras = len(arrive_ns), len(path_from)
    outcome = np.zeros(count, np.int8)
    started = np.full(count, -1, np.int64)
    due = np.full(count, -1, np.int64)
    if discipline == DROP_NEW and cameras == 1:
        # The loop below would decide the same; this one is twice as fast, because no frame waits.
        _drop_new(arrive_ns, work, means_ms, modulated, speeds, starts, states, horizon_ns, outcome, started, due)
        return outcome, started, due
    hints = path_from.copy()
    ticket = np.arange(count)
    head = np.full(cameras, -1, np.int64)  # first waiting frame of each camera; ``follower`` links the others
    tail = np.full(cameras, -1, np.int64)
    follower = np.full(count if discipline == FCFS else 1, -1, np.int64)
    waiting, serving = 0, -1
    free_ns = np.int64(0)
    busy = [np.int64(0)]  # parallel: heap of due instants
    busy.pop()
    n = 0
    while True:
        at_ns = free_ns if waiting > 0 else NEVER_NS
        frame = -1
        while n < count and arrive_ns[n] < 0:
            outcome[n] = SKIPPED
            n += 1
        if n < count and arrive_ns[n] < at_ns:
            at_ns, frame = arrive_ns[n], n
        if at_ns > horizon_ns or at_ns == NEVER_NS:
            break
        if frame >= 0:
            n += 1
            c = camera[frame]
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
                    if head[c] >= 0:
                        outcome[head[c]] = SUPERSEDED
                        ticket[frame] = ticket[head[c]]
                    else:
                        waiting += 1
                    head[c] = frame
                    continue
                if discipline == FCFS:
                    if waiting >= queue_limit:
                        outcome[frame] = DROPPED_BUSY
                        continue
                    if head[c] >= 0:
                        follower[tail[c]] = frame
                    else:
                        head[c] = frame
                    tail[c] = frame
                    waiting += 1
                    continue
                outcome[serving] = SUPERSEDED
        else:
            c = _longest_waiting(head, ticket)
            frame = head[c]
            head[c] = follower[frame] if discipline == FCFS else -1
            waiting -= 1
        while starts[hints[c] + 1] <= at_ns:
            hints[c] += 1
        if modulated:
            due[frame] = completion_ns(
                work[frame],
                speeds,
                starts[path_from[c] : path_to[c]],
                states[path_from[c] : path_to[c] - 1],
                at_ns,
                hints[c] - path_from[c],
            )
        else:
            mean_ms = means_ms[states[hints[c]]] if len(means_ms) > 1 else means_ms[0]
            due[frame] = saturating_add(at_ns, saturating_round(work[frame] * mean_ms * 1e6))
        started[frame] = at_ns
        serving, free_ns = frame, due[frame]
        if discipline == PARALLEL:
            heappush(busy, due[frame])
    for i in range(count):
        if outcome[i] == IN_FLIGHT and 0 <= due[i] <= horizon_ns:
            outcome[i] = DELIVERED
    return outcome, started, due
