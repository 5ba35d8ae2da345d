"""Simulates the links in virtual time, from one seed: the same ``link.Link`` as in the live emulator, without a
clock. Some 70,000 frames a second."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.model import ages
from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.link import MAX_SIZE_BYTES, EventKind, Link, Transit
from channel_emu.model.traffic import PeriodicArrivals, PoissonArrivals
from channel_emu.virtual.link_run import OUTCOME_CODES, OUTCOMES, LinkRun
from channel_emu.virtual.replay import offer_all

# Minutes of computing, and some 10 GB.
_MOST_FRAMES = 2e7
_MOST_CAMERAS = 10_000  # 25 kB each, and ten times as many as a scenario has
_DEFAULT_FRAME_PERIOD_MS = 1000 / 30


class SimulationError(ValueError):
    """A simulation that cannot be run; the message says why."""


@dataclass(frozen=True)
class Simulation:
    """A finished simulation. runs: one a camera, in the order of the cameras."""

    config: ChannelConfig
    seed: int
    seconds: float
    slot_ms: float
    runs: list[LinkRun] = field(repr=False)

    def mean_age_ms(self) -> float | None:
        """Continuous time average of the age, over the cameras that had a delivery; None if none had."""
        return ages.mean_of_known([ages.mean_age_ms(run.sawtooth()) for run in self.runs])

    def summary(self) -> dict[str, Any]:
        """Results as plain values, as the command prints them with --json."""
        saws = [run.sawtooth() for run in self.runs]
        delays = np.concatenate([run.delays_ms() for run in self.runs])
        share = np.mean([run.state_share for run in self.runs], 0)
        counts = {name: sum(run.count(name) for run in self.runs) for name in OUTCOMES}
        return {
            "mean_age_ms": ages.mean_of_known([ages.mean_age_ms(s) for s in saws]),
            "mean_age_slotted_ms": ages.mean_of_known([ages.query_age_ms(s, self.slot_ms) for s in saws]),
            "peak_age_ms": ages.mean_of_known([ages.peak_age_ms(s) for s in saws]),
            "offered": sum(len(run.offered_ns) for run in self.runs),
            "delivered": counts.pop("delivered"),
            "dropped": sum(count for name, count in counts.items() if name != "in_flight"),
            **counts,
            "duplicated": sum(run.duplicated for run in self.runs),
            "state_share": dict(zip(self.config.state_names, (round(float(s), 6) for s in share))),
            "delay_ms": _mean_and_percentiles(delays),
            "cameras": len(self.runs),
            "seconds": self.seconds,
            "slot_ms": self.slot_ms,
            "seed": self.seed,
            "by_camera": {
                r.camera: {"mean_age_ms": ages.mean_age_ms(s), "delivered": r.count("delivered")}
                for r, s in zip(self.runs, saws)
            },
        }


def _mean_and_percentiles(values: NDArray[np.float64]) -> dict[str, float | None]:
    if not len(values):
        return {"mean": None, "p50": None, "p95": None}
    p50, p95 = np.percentile(values, [50, 95])
    return {"mean": float(values.mean()), "p50": float(p50), "p95": float(p95)}


def simulate(
    config: ChannelConfig,
    cameras: int | list[str],
    seconds: float,
    seed: int = 0,
    *,
    frame_period_ms: float | None = None,
    frame_bytes: int = 20_000,
    slot_ms: float = 1.0,
) -> Simulation:
    """Run every camera's link for ``seconds`` of virtual time.

    cameras: their number (cam00, cam01, ...) or their names.
    frame_period_ms: the cameras' capture period. None: Poisson arrivals generate the frames (arrival =
        capture, as in the thesis). Given: they sample the camera's newest frame, as the live emulator does.
    frame_bytes: size of every frame, for faults that depend on it.
    slot_ms: slot length of the slotted mean age (5.2).
    Raises SimulationError if the channel cannot be simulated, or a value is out of range.
    """
    count = cameras if isinstance(cameras, int) else len(cameras)
    if not 1 <= count <= _MOST_CAMERAS:
        raise SimulationError(f"cameras: expected 1 to {_MOST_CAMERAS}, got {count}")
    names = [f"cam{i:02d}" for i in range(count)] if isinstance(cameras, int) else cameras
    if not 0 < seconds <= 1e9:
        raise SimulationError(f"seconds: expected more than 0 and at most 1e9, got {seconds:g}")
    if frame_period_ms is not None and not 1e-3 <= frame_period_ms < math.inf:
        raise SimulationError(f"frame_period_ms: expected at least 0.001, got {frame_period_ms:g}")
    if not 1e-3 <= slot_ms < math.inf:
        raise SimulationError(f"slot_ms: expected at least 0.001, got {slot_ms:g}")
    if not 0 <= frame_bytes <= MAX_SIZE_BYTES:
        raise SimulationError(f"frame_bytes: expected 0 to {MAX_SIZE_BYTES}, got {frame_bytes}")
    frames = count * seconds * 1e3 * _frames_per_ms(config, frame_period_ms)
    if frames > _MOST_FRAMES:
        raise SimulationError(f"about {frames:.1e} frames: expected at most {_MOST_FRAMES:.0e} in one run")
    end_ns = round(seconds * 1e9)
    channel = Channel(config, seed)
    offers: dict[str, list[tuple[int, int]]] = {name: [] for name in names}
    for name in names:
        # A camera's rank in the sorted names is its turn within the period.
        source = _source(config, channel, name, frame_period_ms, sorted(names).index(name) / count)
        at_ns, number = source.next_ns(0, 0), 0
        while at_ns <= end_ns:
            offers[name].append((at_ns, frame_bytes))
            number += 1
            at_ns = source.next_ns(at_ns, number)
    links, transits = offer_all(channel, offers, end_ns, sampled=frame_period_ms is not None)
    runs = [_collect(links[name], transits[name], end_ns) for name in names]
    return Simulation(config, seed, seconds, slot_ms, runs)


def _frames_per_ms(config: ChannelConfig, frame_period_ms: float | None) -> float:
    """Upper bound of one camera's rate of frames. Arrivals that sample a camera's frames generate none."""
    rates = config.arrivals.rate_per_ms
    if rates is None or frame_period_ms is not None:
        return 1 / _camera_period_ms(config, frame_period_ms)
    return max(rates) if isinstance(rates, list) else rates


def _camera_period_ms(config: ChannelConfig, frame_period_ms: float | None) -> float:
    """The cameras' capture period: as given, else the configuration's, else the default."""
    return frame_period_ms or config.arrivals.period_ms or _DEFAULT_FRAME_PERIOD_MS


def _source(
    config: ChannelConfig, channel: Channel, camera: str, frame_period_ms: float | None, phase: float
) -> PeriodicArrivals | PoissonArrivals:
    """The process that generates a camera's offers. phase: offset of a staggered camera, as a fraction of the
    period, in [0, 1)."""
    if frame_period_ms is None and config.arrivals.process == "poisson":
        arrivals = channel.arrivals(camera, channel.chain_of(camera))
        assert arrivals is not None
        return arrivals
    period_ms = _camera_period_ms(config, frame_period_ms)
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
