"""Replays offers in virtual time, and compares a recorded trace with the decisions of fresh links."""

from __future__ import annotations

from typing import Any

from channel_emu.model.channel import Channel
from channel_emu.model.link import Link, Transit
from channel_emu.model.trace import Trace


def offer_all(
    channel: Channel, offers: dict[str, list[tuple[int, int]]], end_ns: int, sampled: bool = True
) -> tuple[dict[str, Link], dict[str, list[Transit]]]:
    """Offer frames to fresh links, in the order of time, as to the live emulator.

    offers: (instant in ns, bytes) of each frame, by camera.
    sampled: see ``Channel.link``.
    Returns links and transits by camera, advanced to ``end_ns``.
    """
    links = {camera: channel.link(camera, sampled=sampled) for camera in offers}
    transits: dict[str, list[Transit]] = {camera: [] for camera in offers}
    for at_ns, camera, size in sorted((at, name, size) for name, given in offers.items() for at, size in given):
        transits[camera].append(links[camera].offer(at_ns, None, size)[0])
    for link in links.values():
        link.advance(end_ns)
    return links, transits


def compare(trace: Trace) -> dict[str, Any]:
    """Offer every recorded message again at its recorded instant, and compare the link's decisions: outcome,
    start, due instant and state.

    Returns frames (number of records), equal (number decided as recorded) and different (one line for each
    difference, at most 20).
    """
    last_ns = max((max(r.offered_ns, r.started_ns or 0, r.ended_ns or 0) for r in trace.records), default=0)
    _, decided = offer_all(Channel(trace.config, trace.seed), trace.offers(), last_ns)
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
