"""Offers the frames of a recorded trace again, in virtual time, and compares what is decided."""

from __future__ import annotations

from channel_emu.model.channel import Channel
from channel_emu.model.trace import Trace
from channel_emu.virtual.simulate import offer_all


def different(trace: Trace) -> list[str]:
    """Every recorded message that, offered again at its recorded instant, gets another outcome, start, due instant or
    state."""
    cameras, found = trace.by_camera(), []
    offers = {name: [(r.offered_ns, r.bytes) for r in records] for name, records in cameras.items()}
    last_ns = max(max(r.offered_ns, r.started_ns or 0, r.ended_ns or 0) for r in trace.records)
    _, decided = offer_all(Channel(trace.config, trace.seed), offers, last_ns)
    for camera, records in cameras.items():
        for then, now in zip(records, decided[camera], strict=True):
            # A message still inside at the end of the recording may have an outcome now.
            same = then.outcome in (None, now.outcome)
            starts = [(each.started_ns, each.due_ns, each.state) for each in (then, now)]
            if not same or (then.started_ns is not None and starts[0] != starts[1]):
                found.append(f"{camera} {then.sequence}: {then.outcome} {starts[0]}, now {now.outcome} {starts[1]}")
    return found
