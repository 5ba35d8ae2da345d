"""The engine ``python`` of ``simulate``: runs ``link.Link`` in virtual time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.link import EventKind, Link, Transit
from channel_emu.model.traffic import PeriodicArrivals, PoissonArrivals
from channel_emu.virtual.link_run import OUTCOME_CODES, LinkRun, camera_period_ms, name_ranks
from channel_emu.virtual.replay import offer_all


def run(
    config: ChannelConfig,
    channel: Channel,
    names: list[str],
    end_ns: int,
    frame_period_ms: float | None,
    frame_bytes: int,
) -> list[LinkRun]:
    """Every camera's run, in the order of ``names``. Arguments as in ``simulate.simulate``."""
    offers: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
    for name, rank in zip(names, name_ranks(names)):
        source = _source(config, channel, name, frame_period_ms, rank / len(names))
        at_ns, number = source.next_ns(0, 0), 0
        while at_ns <= end_ns:
            offers[name].append((at_ns, frame_bytes))
            number += 1
            at_ns = source.next_ns(at_ns, number)
    links, transits = offer_all(channel, offers, end_ns, sampled=frame_period_ms is not None)
    return [_collect(links[name], transits[name], end_ns) for name in names]


def _source(
    config: ChannelConfig, channel: Channel, camera: str, frame_period_ms: float | None, phase: float
) -> PeriodicArrivals | PoissonArrivals:
    """The process that generates a camera's offers. phase: offset of a staggered camera, as a fraction of the
    period, in [0, 1)."""
    if frame_period_ms is None and config.arrivals.process == "poisson":
        arrivals = channel.arrivals(camera, channel.chain_of(camera))
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
