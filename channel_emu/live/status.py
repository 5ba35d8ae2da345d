"""What the emulator says about itself, twice a second: ``OUT/channel.json``, replaced atomically."""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from channel_emu.live.camera_lane import Lane, Measures
from channel_emu.live.histogram import Histogram
from channel_emu.model.channel import Channel
from channel_emu.model.link import Kind
from freshfield.files import write_json

_SERIES_S = 60.0
_SERIES_MOST = 600


class StatusFile:
    """Readers see the old file or the new one, never half of one."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.path = path

    def write(self, state: dict[str, Any]) -> None:
        """A full disk costs a status, not the emulator."""
        with contextlib.suppress(OSError):
            write_json(self.path, state)


def snapshot(
    channel: Channel,
    lanes: Sequence[Lane],
    measures: Measures,
    rejected: dict[str, int],
    now_ns: int,
    priority: str,
    final: bool,
) -> dict[str, Any]:
    """Everything worth knowing now, as plain values.

    ``state`` and ``series`` are those of the shared chain; with a chain for each camera they are in
    ``by_camera``. ``counts`` are over all cameras; ``broken`` counts frames that the edge was not there for.
    """
    now = max(now_ns, 0)
    names = channel.config.state_names
    totals: Counter[str] = Counter()
    by_camera: dict[str, Any] = {}
    for lane in lanes:
        counts = _counts(lane)
        totals.update(counts)
        entry: dict[str, Any] = {
            **counts,
            "connected": lane.upstream is not None and lane.upstream.connected,
            "streams": len(lane.streams),
        }
        if channel.chain is None and lane.link.chain is not None:
            entry["state"] = names[lane.link.chain.state(now)]
        by_camera[lane.camera] = entry
    edge_rejected: Counter[str] = Counter()
    for lane in lanes:
        if lane.upstream is not None:
            edge_rejected.update(lane.upstream.rejected)
    chain = channel.chain
    return {
        "running": not final,
        "preset": channel.config.preset,
        "discipline": channel.config.discipline,
        "seed": channel.seed,
        "priority": priority,
        "uptime_s": round(now / 1e9, 3),
        "states": names,
        "state": None if chain is None else names[chain.state(now)],
        "state_share": _shares(channel, lanes, now),
        "series": _series(channel, now),
        "drawn_delay_ms": _figures(measures.drawn_delay, shape=True),
        "delay_error_ms": _figures(measures.delay_error, shape=final),
        "counts": dict(totals),
        "rejected": dict(rejected),
        "edge_rejected": dict(edge_rejected),
        "by_camera": by_camera,
    }


def _counts(lane: Lane) -> dict[str, int]:
    link = lane.link
    return {
        "received": lane.received,
        "held_out": lane.held_out,
        "forwarded": lane.forwarded,
        **{str(kind): link.counts[kind] for kind in Kind if kind is not Kind.STARTED},
        # Both a stream reset by the channel and an edge that was away break frames.
        "broken": link.counts[Kind.BROKEN] + lane.broken,
        "in_flight": link.in_flight + (lane.upstream.pending if lane.upstream is not None else 0),
        "clock_backwards": link.clock_backwards,
    }


def _shares(channel: Channel, lanes: Sequence[Lane], now_ns: int) -> dict[str, float]:
    chains = [channel.chain] if channel.chain else [lane.link.chain for lane in lanes if lane.link.chain]
    if not chains:
        return {}
    shares = [chain.occupancy(now_ns) for chain in chains if chain is not None]
    return {
        name: round(sum(s[i] for s in shares) / len(shares), 6)
        for i, name in enumerate(channel.config.state_names)
    }


def _series(channel: Channel, now_ns: int) -> list[tuple[float, str]]:
    """(seconds, state entered) over the last minute."""
    if channel.chain is None:
        return []
    names = channel.config.state_names
    recent = channel.chain.recent(max(0, now_ns - int(_SERIES_S * 1e9)), now_ns)
    return [(round(start / 1e9, 4), names[state]) for start, state in recent[-_SERIES_MOST:]]


def _figures(histogram: Histogram, shape: bool) -> dict[str, Any]:
    def rounded(value: float | None) -> float | None:
        return None if value is None else round(value, 4)

    figures: dict[str, Any] = {
        "count": histogram.count,
        "mean": rounded(histogram.mean_ms),
        "p50": rounded(histogram.percentile_ms(50)),
        "p95": rounded(histogram.percentile_ms(95)),
        "p99": rounded(histogram.percentile_ms(99)),
        "max": rounded(histogram.max_ms if histogram.count else None),
    }
    if shape:
        edges_ms, counts = histogram.linear()
        figures["histogram"] = {"edges_ms": edges_ms, "counts": counts}
    return figures
