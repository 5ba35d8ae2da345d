"""Decides a recorded trace again in virtual time and compares every decision."""

from __future__ import annotations

from typing import Any

from channel_emu.model.trace import Trace
from channel_emu.virtual.simulate import replay_offers


def compare(trace: Trace) -> dict[str, Any]:
    """Offer every recorded message again, at its recorded instant, to fresh links of the recorded channel.

    Returns {frames: records compared, equal: decided as recorded, different: [one line each, at most 20]}.
    Outcome, start, due instant and state of each message must be those recorded.
    """
    last_ns = max((max(r.offered_ns, r.started_ns or 0, r.ended_ns or 0) for r in trace.records), default=0)
    decided = replay_offers(trace.config, trace.seed, trace.offers(), last_ns)
    different = []
    for camera, records in trace.by_camera().items():
        for record, transit in zip(records, decided[camera]):
            outcome = None if transit.outcome is None else str(transit.outcome)
            # A message that was still inside when the recording ended may have an outcome now.
            same = record.outcome is None or record.outcome == outcome
            if record.started_ns is not None:
                now = (transit.started_ns, transit.due_ns, transit.state)
                same = same and (record.started_ns, record.due_ns, record.state) == now
            if not same:
                then = f"recorded {record.outcome} due {record.due_ns}"
                different.append(f"{camera} {record.sequence}: {then}, now {outcome} due {transit.due_ns}")
    return {
        "frames": len(trace.records),
        "equal": len(trace.records) - len(different),
        "different": different[:20],
    }
