"""Runs ``link.Link`` in virtual time: what ``simulate`` does with ``engine="python"``."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.link import EventKind, Link, Transit
from channel_emu.model.traffic import PeriodicArrivals, PoissonArrivals
from channel_emu.virtual.link_run import OUTCOME_CODES, LinkRun, camera_period_ms, name_ranks


def run(
    config: ChannelConfig,
    channel: Channel,
    names: list[str],
    end_ns: int,
    frame_period_ms: float | None,
    frame_bytes: int,
) -> list[LinkRun]:
    """Every camera's run, in the order of ``names``; the arguments are those of ``simulate.simulate``."""
    links = [channel.link(name, sampled=frame_period_ms is not None) for name in names]
    ranks = name_ranks(names)
    sources = [
        _source(config, channel, link, frame_period_ms, rank / len(names)) for link, rank in zip(links, ranks)
    ]
    transits: list[list[Transit]] = [[] for _ in names]
    # (next offer's instant, camera's rank, camera, number of the offer)
    offers = [(source.next_ns(0, 0), ranks[i], i, 0) for i, source in enumerate(sources)]
    heapq.heapify(offers)
    while offers[0][0] <= end_ns:
        at_ns, _, i, number = offers[0]
        transits[i].append(links[i].offer(at_ns, None, frame_bytes)[0])
        heapq.heapreplace(offers, (sources[i].next_ns(at_ns, number + 1), ranks[i], i, number + 1))
    for link in links:
        link.advance(end_ns)
    return [_collect(link, each, end_ns) for link, each in zip(links, transits)]


def _source(
    config: ChannelConfig, channel: Channel, link: Link, frame_period_ms: float | None, phase: float
) -> PeriodicArrivals | PoissonArrivals:
    """phase: in [0, 1), the part of the period by which a staggered camera is late."""
    if frame_period_ms is None and config.arrivals.process == "poisson":
        arrivals = channel.arrivals(link.camera, link.chain)
        assert arrivals is not None
        return arrivals
    period_ms = camera_period_ms(config, frame_period_ms)
    return PeriodicArrivals(period_ms, phase * period_ms if config.arrivals.spread else 0.0)


def _collect(link: Link, transits: list[Transit], end_ns: int) -> LinkRun:
    def column(values: list[int | None]) -> NDArray[np.int64]:
        return np.array([-1 if v is None else v for v in values], np.int64)

    return LinkRun(
        link.camera,
        column([t.offered_ns for t in transits]),
        np.array([OUTCOME_CODES[t.outcome] if t.outcome else 0 for t in transits], np.int8),
        column([t.started_ns for t in transits]),
        column([t.due_ns for t in transits]),
        end_ns,
        [1.0] if link.chain is None else link.chain.occupancy(end_ns),
        link.counts[EventKind.DUPLICATED],
    )
