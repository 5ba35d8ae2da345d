"""Simulates the links in virtual time, from one seed: the same ``link.Link`` as in the live emulator, without a
clock. Some 70,000 frames a second."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu import emulator_constants as tuned
from channel_emu.model.ages import RunningAge, mean_of_known
from channel_emu.model.channel import Channel
from channel_emu.model.link import MAX_SIZE_BYTES, EventKind, Link, Transit
from channel_emu.model.settings import ChannelConfig
from channel_emu.model.traffic import PoissonArrivals
from freshfield.files import write_csv

OUTCOMES = tuple(kind for kind in EventKind if kind not in (EventKind.STARTED, EventKind.DUPLICATED))


class SimulationError(ValueError):
    """A simulation that cannot be run; the message says why."""


@dataclass(frozen=True)
class LinkRun:
    """One camera's link at the end of the run, and its frames in the order of their offers."""

    link: Link
    transits: list[Transit]
    end_ns: int

    @property
    def camera(self) -> str:
        return self.link.camera

    def deliveries_ns(self) -> NDArray[np.int64]:
        """(n, 2): capture, which in virtual time is the offer, and arrival of each delivered frame, in the order of
        arrival."""
        came = [(t.offered_ns, t.ended_ns or 0) for t in self.transits if t.outcome is EventKind.DELIVERED]
        return np.array(sorted(came, key=lambda pair: pair[::-1]), np.int64).reshape(-1, 2)

    def age(self) -> RunningAge:
        """The age over time."""
        return RunningAge((arrived, captured) for captured, arrived in self.deliveries_ns().tolist())


@dataclass(frozen=True)
class Simulation:
    """A finished simulation. runs: one a camera, in the order of the cameras."""

    config: ChannelConfig
    seed: int
    seconds: float
    runs: list[LinkRun] = field(repr=False)

    def ages_ms(self, every_ms: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Instants (T,) in seconds, every ``every_ms`` from 0 on, and the age (cameras, T) of each camera's newest
        arrived frame then, in milliseconds; NaN before the first. Raises SimulationError for a period out of range."""
        if not every_ms > 0.0 or len(self.runs) * self.seconds * 1e3 / every_ms > tuned.MOST_FRAMES:
            raise SimulationError(
                f"every_ms: expected more than 0 and at most {tuned.MOST_FRAMES:.0e} ages, got {every_ms}"
            )
        at_ns = np.arange(0, round(self.seconds * 1e9) + 1, round(every_ms * 1e6))
        ages = np.full((len(self.runs), len(at_ns)), np.nan)
        for row, run in zip(ages, self.runs):
            captured, arrived = run.deliveries_ns().T
            newest = np.maximum.accumulate(captured)
            known = np.searchsorted(arrived, at_ns, side="right") - 1
            row[known >= 0] = (at_ns[known >= 0] - newest[known[known >= 0]]) / 1e6
        return at_ns / 1e9, ages

    def summary(self) -> dict[str, Any]:
        """Results as plain values, as the command prints them with --json."""
        ages = [run.age() for run in self.runs]
        mean_ages = [age.mean_age_ms(run.end_ns) for age, run in zip(ages, self.runs)]
        frames = [(run.end_ns, t) for run in self.runs for t in run.transits]
        due = [t for end_ns, t in frames if t.due_ns is not None and t.due_ns <= end_ns]
        delays = np.array([(t.drawn_ns or 0) / 1e6 for t in due])
        chains = [run.link.chain for run in self.runs]
        share = np.mean([[1.0] if c is None else c.occupancy(r.end_ns) for c, r in zip(chains, self.runs)], 0)
        counts = Counter[str]()
        for run in self.runs:
            counts.update(run.link.counts)
        return {
            "mean_age_ms": mean_of_known(mean_ages),
            "peak_age_ms": mean_of_known([age.peak_age_ms() for age in ages]),
            "offered": sum(run.link.offered for run in self.runs),
            "in_flight": sum(run.link.in_flight for run in self.runs),
            "dropped": sum(counts[kind] for kind in OUTCOMES if kind is not EventKind.DELIVERED),
            **{str(kind): counts[kind] for kind in (*OUTCOMES, EventKind.DUPLICATED)},
            "corrupted": sum(t.outcome is EventKind.DELIVERED and bool(t.flips) for _, t in frames),
            "state_share": dict(zip(self.config.state_names, (round(float(s), 6) for s in share))),
            "delay_ms": {
                "mean": float(delays.mean()) if len(delays) else None,
                **{f"p{q}": float(np.percentile(delays, q)) if len(delays) else None for q in (50, 95)},
            },
            "cameras": len(self.runs),
            "seconds": self.seconds,
            "seed": self.seed,
            "by_camera": {
                run.camera: {"mean_age_ms": age_ms, "delivered": run.link.counts[EventKind.DELIVERED]}
                for run, age_ms in zip(self.runs, mean_ages)
            },
        }

    def write_frames(self, path: Path) -> None:
        """Write CSV rows offered_ms, delivered_ms (empty: not delivered), camera and outcome (an ``EventKind``, empty
        while inside the link), as ``channel-emu fit`` reads them. Raises OSError."""
        rows = []
        for run in self.runs:
            for t in run.transits:
                due_ms = (t.ended_ns or 0) / 1e6 if t.outcome is EventKind.DELIVERED else ""
                row = {"offered_ms": t.offered_ns / 1e6, "delivered_ms": due_ms, "camera": run.camera}
                rows.append({**row, "outcome": str(t.outcome or "")})
        write_csv(path, rows)


def simulate(
    config: ChannelConfig,
    cameras: int | list[str],
    seconds: float,
    seed: int = 0,
    *,
    frame_period_ms: float | None = None,
    frame_bytes: int = tuned.FRAME_BYTES,
) -> Simulation:
    """Run every camera's link for ``seconds`` of virtual time.

    cameras: their number (cam00, cam01, ...) or their names.
    frame_period_ms: the cameras' capture period. None: Poisson arrivals generate the frames (arrival =
        capture, as in the thesis). Given: they sample the camera's newest frame, as the live emulator does.
    frame_bytes: size of every frame, for faults that depend on it.
    Raises SimulationError if the channel cannot be simulated, or a value is out of range.
    """
    count = cameras if isinstance(cameras, int) else len(cameras)
    names = [f"cam{i:02d}" for i in range(count)] if isinstance(cameras, int) else cameras
    for name, value, least, most in (
        ("cameras", count, 1, tuned.MOST_CAMERAS),
        ("seconds", seconds, 1e-9, 1e9),
        ("frame_period_ms", 1.0 if frame_period_ms is None else frame_period_ms, 1e-3, 1e12),
        ("frame_bytes", frame_bytes, 0, MAX_SIZE_BYTES),
    ):
        if not least <= value <= most:
            raise SimulationError(f"{name}: expected {least:g} to {most:g}, got {value}")
    if strange := [name for name in getattr(config.faults.get("blackout"), "cameras", ()) if name not in names]:
        raise SimulationError(
            f"faults.blackout.cameras: {strange[0]!r} is none of the {count} simulated: {', '.join(names)}"
        )
    period_ms = frame_period_ms or config.arrivals.period_ms or tuned.FRAME_PERIOD_MS
    generated = config.arrivals.process == "poisson" and frame_period_ms is None
    rates = config.arrivals.rate_per_ms
    most_per_ms = (max(rates) if isinstance(rates, list) else rates or 0.0) if generated else 1 / period_ms
    frames = count * seconds * 1e3 * most_per_ms
    if frames > tuned.MOST_FRAMES:
        raise SimulationError(f"about {frames:.1e} frames: expected at most {tuned.MOST_FRAMES:.0e} in one run")
    end_ns = round(seconds * 1e9)
    channel = Channel(config, seed)
    offers = {}
    for name in names:
        source = channel.arrivals(name, channel.chain_of(name)) if generated else None
        instants = range(0, end_ns + 1, round(period_ms * 1e6)) if source is None else _instants(source, end_ns)
        offers[name] = [(at_ns, frame_bytes) for at_ns in instants]
    links, transits = offer_all(channel, offers, end_ns, sampled=frame_period_ms is not None)
    return Simulation(config, seed, seconds, [LinkRun(links[name], transits[name], end_ns) for name in names])


def _instants(source: PoissonArrivals, end_ns: int) -> list[int]:
    """The arrivals up to ``end_ns``."""
    found: list[int] = []
    at_ns = source.next_ns(0, 0)
    while at_ns <= end_ns:
        found.append(at_ns)
        at_ns = source.next_ns(at_ns, len(found))
    return found


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
