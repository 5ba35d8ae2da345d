"""The emulator's status, which ``frame_proxy`` writes to ``OUT/channel.json`` twice a second."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

from channel_emu.live.camera_stream import CameraStream
from channel_emu.live.histogram import Histogram
from channel_emu.live.live_link import DelayStats
from channel_emu.model.channel import Channel
from channel_emu.model.link import EventKind

SET_BY_HAND = "set by hand"
"""The state while an operator's delays and losses are in force."""


def snapshot(
    channel: Channel,
    flows: Sequence[CameraStream],
    stats: DelayStats,
    rejected: dict[str, int],
    now_ns: int,
    priority: str,
    final: bool,
    changes: Sequence[dict[str, Any]] = (),
) -> dict[str, Any]:
    """The status as plain values, at the channel's instant ``now_ns``.

    flows: of all cameras.
    stats: delays of all links together.
    rejected: frames refused by the emulator, by reason.
    priority: see ``priority.raise_priority``.
    final: whether the emulator is ending.
    changes: by operators, see ``ChannelService``.

    ``state`` is that of the shared chain, or SET_BY_HAND; with one chain a camera, ``by_camera`` has the states.
    ``counts`` are sums over all cameras; ``broken`` counts frames broken by a reset or a missing edge.
    """
    now = max(now_ns, 0)
    by_hand, names = channel.by_hand, channel.config.state_names
    totals: Counter[str] = Counter()
    by_camera: dict[str, Any] = {}
    edge_rejected: Counter[str] = Counter()
    for flow in flows:
        counts = _counts(flow)
        totals.update(counts)
        edge_rejected.update(flow.rejected)
        entry: dict[str, Any] = {**counts, "connected": flow.connected, "streams": len(flow.link.calls)}
        if by_hand is None and channel.chain is None and flow.link.model.chain is not None:
            entry["state"] = names[flow.link.model.chain.state(now)]
        by_camera[flow.camera] = entry
    chain = channel.chain
    return {
        "running": not final,
        "preset": channel.config.preset,
        "discipline": channel.config.discipline,
        "seed": channel.seed,
        "priority": priority,
        "uptime_s": round(now / 1e9, 3),
        "states": names,
        "state": SET_BY_HAND if by_hand else None if chain is None else names[chain.state(now)],
        "by_hand": None if by_hand is None else {"delay_ms": by_hand[0], "loss": by_hand[1]},
        "changes": list(changes),
        "state_share": _shares(channel, flows, now),
        "drawn_delay_ms": _figures(stats.drawn, shape=True),
        "delay_error_ms": _figures(stats.error, shape=final),
        "counts": dict(totals),
        "rejected": dict(rejected),
        "edge_rejected": dict(edge_rejected),
        "by_camera": by_camera,
    }


def _counts(flow: CameraStream) -> dict[str, int]:
    link = flow.link.model
    return {
        "received": link.offered + flow.held_out,
        "held_out": flow.held_out,
        "forwarded": flow.forwarded,
        **{str(kind): link.counts[kind] for kind in EventKind if kind is not EventKind.STARTED},
        # Frames are broken by a reset of the stream, and by an edge that is not connected.
        "broken": link.counts[EventKind.BROKEN] + flow.broken,
        "in_flight": link.in_flight + flow.pending,
        "clock_backwards": link.clock_backwards,
    }


def _shares(channel: Channel, flows: Sequence[CameraStream], now_ns: int) -> dict[str, float]:
    chains = [channel.chain] if channel.chain else [flow.link.model.chain for flow in flows]
    shares = [chain.occupancy(now_ns) for chain in chains if chain is not None]
    if not shares:
        return {}
    return {
        name: round(sum(s[i] for s in shares) / len(shares), 6) for i, name in enumerate(channel.config.state_names)
    }


def _figures(histogram: Histogram, shape: bool) -> dict[str, Any]:
    figures: dict[str, Any] = {
        "count": histogram.count,
        **{name: None if value is None else round(value, 4) for name, value in histogram.summary().items()},
    }
    if shape:
        edges_ms, counts = histogram.linear()
        figures["histogram"] = {"edges_ms": edges_ms, "counts": counts}
    return figures
