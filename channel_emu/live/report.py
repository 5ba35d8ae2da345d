"""Outcomes, ages and delays of the messages that passed the links, as data or as text."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from channel_emu.live.live_link import DelayStats, LiveLink
from channel_emu.model.ages import mean_of_known
from channel_emu.model.link import EventKind

DROPPED = (EventKind.DROPPED_BUSY, EventKind.SUPERSEDED, EventKind.SKIPPED, EventKind.LOST, EventKind.BROKEN)


@dataclass(frozen=True)
class Figures:
    """Statistics of one link, or of all links together. offered = delivered + dropped + in_flight.

    outcomes: counts by ``link.EventKind``, and ``forwarded`` (handed on), ``cancelled`` (delivered after the
        call was over) and ``overfull`` (dropped before the link for lack of room; not in ``offered``).
    mean_age_ms, peak_age_ms: age of the newest message handed on, from its arrival at the proxy, between the
        first one handed on and the last that came in or was handed on. Mean over the links that have a value,
        None if none has.
    delay_ms: delay drawn by the link.
    latency_ms: from receiving a message to handing it on.
    error_ms: from the instant at which a message, and those before it in its stream, was due to handing it on.
    """

    offered: int
    delivered: int
    dropped: int
    in_flight: int
    outcomes: dict[str, int]
    mean_age_ms: float | None
    peak_age_ms: float | None
    delay_ms: dict[str, float | None]
    latency_ms: dict[str, float | None]
    error_ms: dict[str, float | None]


@dataclass(frozen=True)
class Report(Figures):
    """All links together.

    seed, direction: of the proxy. seconds: since its start.
    by_method: statistics of each link, under a name such as ``up /pkg.Service/Method``.
    """

    seed: int
    direction: str
    seconds: float
    by_method: dict[str, Figures] = field(default_factory=dict)

    def plain(self) -> dict[str, Any]:
        """The report as plain values, for JSON."""
        return asdict(self)


def figures_of(links: Sequence[LiveLink], stats: DelayStats) -> Figures:
    """Statistics of ``links``, whose delays are counted in ``stats``."""
    outcomes: Counter[str] = Counter()
    for link in links:
        outcomes.update({str(kind): count for kind, count in link.model.counts.items()})
        outcomes.update(forwarded=link.forwarded, cancelled=link.cancelled, overfull=link.overfull)
    return Figures(
        offered=sum(link.model.offered for link in links),
        delivered=outcomes[EventKind.DELIVERED],
        dropped=sum(outcomes[kind] for kind in DROPPED),
        in_flight=sum(link.model.in_flight for link in links),
        outcomes={name: count for name, count in outcomes.items() if count},
        mean_age_ms=mean_of_known([link.age.mean_age_ms(link.last_ns) for link in links]),
        peak_age_ms=mean_of_known([link.age.peak_age_ms() for link in links]),
        delay_ms=stats.drawn.summary(),
        latency_ms=stats.latency.summary(),
        error_ms=stats.error.summary(),
    )


def show(report: Report) -> str:
    """The report as text, two lines a link."""
    lines = []
    for name, figures in report.by_method.items():
        outcomes = ", ".join(f"{count} {kind}" for kind, count in figures.outcomes.items())
        lines.append(f"  {name}: {figures.offered} offered; {outcomes or 'none settled'}")
        lines.append(
            f"    mean age {_ms(figures.mean_age_ms)}, peak age {_ms(figures.peak_age_ms)}, "
            f"delay mean {_ms(figures.delay_ms['mean'])}, error p99 {_ms(figures.error_ms['p99'])}"
        )
    return "\n".join(lines) or "  no call was made"


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f} ms"
