"""Offers the frames of a recorded trace again, in virtual time, and compares what is decided."""

from __future__ import annotations

from typing import Any

from channel_emu.model.channel import Channel
from channel_emu.model.trace import Trace
from channel_emu.virtual.simulate import offer_all


def offers(trace: Trace) -> dict[str, list[tuple[int, int]]]:
    """(instant in ns, bytes) of every offer, by camera."""
    return {name: [(r.offered_ns, r.bytes) for r in found] for name, found in trace.by_camera().items()}


def compare(trace: Trace) -> dict[str, Any]:
    """Offer every recorded message again at its recorded instant, and compare the link's decisions: outcome,
    start, due instant and state.

    Returns frames (number of records), equal (number decided as recorded) and different (one line for each
    difference, at most 20).
    """
    last_ns = max((max(r.offered_ns, r.started_ns or 0, r.ended_ns or 0) for r in trace.records), default=0)
    _, decided = offer_all(Channel(trace.config, trace.seed), offers(trace), last_ns)
    different = []
    for camera, records in trace.by_camera().items():
        for record, transit in zip(records, decided[camera]):
            outcome = None if transit.outcome is None else str(transit.outcome)
            # A message still inside at the end of the recording may have an outcome now.
            same = record.outcome is None or record.outcome == outcome
            if record.started_ns is not None:
                now = (transit.started_ns, transit.due_ns, transit.state)
                same = same and (record.started_ns, record.due_ns, record.state) == now
            if not same:
                then = f"recorded {record.outcome} due {record.due_ns}"
                different.append(f"{camera} {record.sequence}: {then}, now {outcome} due {transit.due_ns}")
    return {"frames": len(trace.records), "equal": len(trace.records) - len(different), "different": different[:20]}
