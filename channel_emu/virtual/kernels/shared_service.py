"""One server for several cameras: the decisions of ``queue_server.QueueServer``, over whole arrays."""

from __future__ import annotations

from heapq import heappop, heappush

import numpy as np
from numba import njit

from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.virtual.kernels.chain_path import completion_ns, saturating_add, saturating_round
from channel_emu.virtual.kernels.link_service import (
    DELIVERED,
    DROP_NEW,
    DROPPED_BUSY,
    FCFS,
    IN_FLIGHT,
    NEWEST_WAITS,
    PARALLEL,
    SUPERSEDED,
    speeds_per_ns,
)

# Orders, as in queue_server.ORDERS.
FIRST_COME, NEWEST_FIRST, ROUND_ROBIN, OLDEST_AGE = 0, 1, 2, 3


@njit(cache=True, nogil=True)
def _choose(order, head, ticket, last, newest_delivered_ns):
    """The camera whose waiting frame is next; at least one waits."""
    cameras = len(head)
    best = -1
    for k in range(cameras):
        c = (last + 1 + k) % cameras if order == ROUND_ROBIN else k
        if head[c] < 0:
            continue
        if best < 0:
            best = c
        elif order == FIRST_COME:
            if ticket[head[c]] < ticket[head[best]]:
                best = c
        elif order == NEWEST_FIRST:
            if ticket[head[c]] > ticket[head[best]]:
                best = c
        elif order == OLDEST_AGE and newest_delivered_ns[c] < newest_delivered_ns[best]:
            best = c
        if order == ROUND_ROBIN:
            break
    return best


@njit(cache=True, nogil=True)
def serve_shared(
    arrive_ns, offered_ns, camera, discipline, order, queue_limit, work, means_ms, modulated, starts, states,
    path_from, path_to, horizon_ns,
):  # fmt: skip
    """Outcome int8, started and due int64 ns (-1: never) of each frame, each (n,).

    arrive_ns, offered_ns, camera, work: of the frames of all cameras (n,), in the order in which they arrive.
    order: index into ``queue_server.ORDERS``: whose waiting frame is next.
    starts, states: all paths; camera c's is starts[path_from[c] : path_to[c]], with one entry of ``states``
        unused at its end.
    The rest is as for ``link_service.serve``.
    """
    count, cameras = len(arrive_ns), len(path_from)
    outcome = np.zeros(count, np.int8)
    started = np.full(count, -1, np.int64)
    due = np.full(count, -1, np.int64)
    speeds = speeds_per_ns(means_ms)
    hints = path_from.copy()
    ticket = np.arange(count)
    head = np.full(cameras, -1, np.int64)  # of each camera's waiting frames, which ``follower`` links
    tail = np.full(cameras, -1, np.int64)
    follower = np.full(count if discipline == FCFS else 1, -1, np.int64)
    newest_delivered_ns = np.full(cameras, -1, np.int64)
    waiting, serving, last = 0, -1, cameras - 1
    free_ns = np.int64(0)
    busy = [np.int64(0)]  # parallel: heap of due instants
    busy.pop()
    n = 0
    while True:
        at_ns = free_ns if waiting > 0 else NEVER_NS
        frame = -1
        if n < count and arrive_ns[n] < at_ns:
            at_ns, frame = arrive_ns[n], n
        if at_ns > horizon_ns or at_ns == NEVER_NS:
            break
        if serving >= 0 and due[serving] <= at_ns:
            c = camera[serving]
            newest_delivered_ns[c] = max(newest_delivered_ns[c], offered_ns[serving])
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
                        if order == FIRST_COME:
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
            c = _choose(order, head, ticket, last, newest_delivered_ns)
            frame = head[c]
            head[c] = follower[frame] if discipline == FCFS else -1
            waiting -= 1
        while starts[hints[c] + 1] <= at_ns:
            hints[c] += 1
        if modulated:
            due[frame] = completion_ns(
                work[frame], speeds, starts[path_from[c] : path_to[c]], states[path_from[c] : path_to[c] - 1],
                at_ns, hints[c] - path_from[c],
            )  # fmt: skip
        else:
            mean_ms = means_ms[states[hints[c]]] if len(means_ms) > 1 else means_ms[0]
            due[frame] = saturating_add(at_ns, saturating_round(work[frame] * mean_ms * 1e6))
        started[frame] = at_ns
        serving, free_ns, last = frame, due[frame], c
        if discipline == PARALLEL:
            heappush(busy, due[frame])
    for i in range(count):
        if outcome[i] == IN_FLIGHT and 0 <= due[i] <= horizon_ns:
            outcome[i] = DELIVERED
    return outcome, started, due
