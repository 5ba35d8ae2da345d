"""The same links in virtual time: thousands of camera-seconds in a moment, from one seed.

Two engines give the same frames the same fates: ``python`` drives ``link.Link`` by an event loop,
``kernel`` (numba) computes whole arrays. Faults and a chain that is white noise need the Python one.
"""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.model import ages
from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.link import Kind, Link, Transit
from channel_emu.model.traffic import PeriodicArrivals, PoissonArrivals

OUTCOMES = ("in_flight", *(str(k) for k in (Kind.DELIVERED, Kind.DROPPED_BUSY, Kind.SUPERSEDED, Kind.SKIPPED,
                                            Kind.LOST, Kind.BROKEN)))  # fmt: skip
_CODES = {name: code for code, name in enumerate(OUTCOMES)}
DEFAULT_FRAME_PERIOD_MS = 1000 / 30
_MOST_FRAMES = 1e9


class SimulationError(ValueError):
    """A simulation that cannot be run as asked; the message says why."""


@dataclass(frozen=True)
class LinkRun:
    """One camera's frames: instants int64 ns (n,), -1 where there is none; outcome: index into OUTCOMES."""

    camera: str
    offered_ns: NDArray[np.int64]
    outcome: NDArray[np.int8]
    started_ns: NDArray[np.int64]
    due_ns: NDArray[np.int64]
    end_ns: int
    state_share: list[float]
    duplicated: int = 0

    def count(self, outcome: str) -> int:
        return int((self.outcome == _CODES[outcome]).sum())

    def sawtooth(self) -> ages.Sawtooth:
        """Ages run from capture, which in virtual time is the offer."""
        arrived = self.outcome == _CODES["delivered"]
        return ages.sawtooth(self.due_ns[arrived], self.offered_ns[arrived], self.end_ns)

    def delays_ms(self) -> NDArray[np.float64]:
        """The drawn delay of every frame whose transmission ended within the run."""
        done = (self.started_ns >= 0) & (self.due_ns <= self.end_ns)
        return (self.due_ns - self.started_ns)[done] / 1e6


@dataclass(frozen=True)
class Simulation:
    config: ChannelConfig
    seed: int
    seconds: float
    slot_ms: float
    engine: str
    runs: list[LinkRun] = field(repr=False)

    def omega(self, at_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The set Omega(t) at any instants (T,), in any order: when the newest frame that had arrived of each
        camera was generated, int64 ns (T, cameras); -1 before a camera's first delivery (thesis 5.4, 6.2).

        What is delivered at an instant counts at it, as for a decision that falls on it.
        """
        at = np.asarray(at_ns, np.int64)
        return np.stack([ages.newest_at(run.sawtooth(), at) for run in self.runs], -1)

    def ages_ms(self, at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Ages at any instants (T,) in ms, (T, cameras); NaN before a camera's first delivery (5.5)."""
        born_ns = self.omega(at_ns)
        return np.where(born_ns >= 0, (np.asarray(at_ns, np.int64)[..., None] - born_ns) / 1e6, np.nan)

    def mean_age_ms(self) -> float | None:
        """Continuous time average, over the cameras that had a delivery; None where there was none."""
        return _mean([ages.mean_age_ms(run.sawtooth()) for run in self.runs])

    def summary(self) -> dict[str, Any]:
        """What the command prints with --json."""
        saws = [run.sawtooth() for run in self.runs]
        delays = np.concatenate([run.delays_ms() for run in self.runs])
        share = np.mean([run.state_share for run in self.runs], 0)
        counts = {name: sum(run.count(name) for run in self.runs) for name in OUTCOMES}
        return {
            "mean_age_ms": _mean([ages.mean_age_ms(s) for s in saws]),
            "mean_age_slotted_ms": _mean([ages.mean_age_slotted_ms(s, self.slot_ms) for s in saws]),
            "peak_age_ms": _mean([ages.peak_age_ms(s) for s in saws]),
            "offered": sum(len(run.offered_ns) for run in self.runs),
            "delivered": counts.pop("delivered"),
            "dropped": counts["dropped_busy"],
            **counts,
            "duplicated": sum(run.duplicated for run in self.runs),
            "state_share": dict(zip(self.config.state_names, (round(float(s), 6) for s in share))),
            "delay_ms": spread(delays),
            "cameras": len(self.runs),
            "seconds": self.seconds,
            "slot_ms": self.slot_ms,
            "seed": self.seed,
            "engine": self.engine,
            "by_camera": {r.camera: {"mean_age_ms": ages.mean_age_ms(s), "delivered": r.count("delivered")}
                          for r, s in zip(self.runs, saws)},
        }  # fmt: skip


def spread(values: NDArray[np.float64]) -> dict[str, float | None]:
    """Mean, median and 95th percentile; None where there are no values."""
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
    engine: str = "auto",
    frame_period_ms: float | None = None,
    frame_bytes: int = 20_000,
    slot_ms: float = 1.0,
    threads: int | None = None,
) -> Simulation:
    """Run every camera's link for ``seconds`` of virtual time.

    cameras: how many (cam00, cam01, ...) or their names. frame_period_ms: the cameras' own period. With
    Poisson arrivals frames are made by the arrivals themselves (arrival = capture, as in the thesis) unless
    it is given: then the arrivals sample the camera's newest frame, as the live emulator does.
    engine: auto, python or kernel. threads: of the kernel; None takes what the machine has where a run is
    long enough. The result does not depend on it. Raises SimulationError.
    """
    names = [f"cam{i:02d}" for i in range(cameras)] if isinstance(cameras, int) else cameras
    if not names:
        raise SimulationError("cameras: expected at least one")
    if not 0 < seconds <= 1e9:
        raise SimulationError(f"seconds: expected more than 0 and at most 1e9, got {seconds:g}")
    if frame_period_ms is not None and not 1e-3 <= frame_period_ms < math.inf:
        raise SimulationError(f"frame_period_ms: expected at least 0.001, got {frame_period_ms:g}")
    if not 1e-3 <= slot_ms < math.inf:
        raise SimulationError(f"slot_ms: expected at least 0.001, got {slot_ms:g}")
    frames = len(names) * seconds * 1e3 * _frames_per_ms(config, frame_period_ms)
    if frames > _MOST_FRAMES:
        raise SimulationError(f"about {frames:.1e} frames: expected at most {_MOST_FRAMES:.0e} in one run")
    end_ns = round(seconds * 1e9)
    channel = Channel(config, seed)
    why_not = _kernel_lacks(config, channel)
    if engine == "kernel" and why_not:
        raise SimulationError(f"engine kernel: {why_not}")
    if engine == "auto":
        engine = "python" if why_not else "kernel"
    if engine == "kernel":
        from channel_emu.virtual import kernel_engine

        runs = kernel_engine.run(config, channel, names, end_ns, frame_period_ms, threads)
    elif engine == "python":
        runs = _run_python(config, channel, names, end_ns, frame_period_ms, frame_bytes)
    else:
        raise SimulationError(f"engine: expected auto, python or kernel, got {engine!r}")
    return Simulation(config, seed, seconds, slot_ms, engine, runs)


def replay_offers(
    config: ChannelConfig,
    seed: int,
    offers: dict[str, list[tuple[int, int]]],
    end_ns: int,
    on_event: Callable[[Link, Any], None] | None = None,
) -> dict[str, list[Transit]]:
    """Offer frames at the given (instant ns, bytes) to fresh links, merged in time; the fates by camera.

    This is what the live emulator would have decided, had it been offered frames at those instants.
    """
    channel = Channel(config, seed)
    links = {camera: channel.link(camera) for camera in offers}
    fates: dict[str, list[Transit]] = {camera: [] for camera in offers}
    merged = sorted((at_ns, camera, size) for camera, given in offers.items() for at_ns, size in given)
    for at_ns, camera, size in merged:
        transit, events = links[camera].offer(at_ns, None, size)
        fates[camera].append(transit)
        for event in events if on_event else ():
            on_event(links[camera], event)  # type: ignore[misc]
    for link in links.values():
        for event in link.advance(end_ns):
            if on_event:
                on_event(link, event)
    return fates


def _run_python(
    config: ChannelConfig,
    channel: Channel,
    names: list[str],
    end_ns: int,
    frame_period_ms: float | None,
    frame_bytes: int,
) -> list[LinkRun]:
    sampled = frame_period_ms is not None
    links = [channel.link(name, sampled=sampled) for name in names]
    rank = ranks(names)
    sources = [
        _source(config, channel, link, frame_period_ms, k / len(names)) for link, k in zip(links, rank)
    ]
    fates: list[list[Transit]] = [[] for _ in names]
    # (next offer's instant, camera's rank, camera, number of the offer)
    offers = [(source.next_ns(0, 0), rank[i], i, 0) for i, source in enumerate(sources)]
    heapq.heapify(offers)
    while offers[0][0] <= end_ns:
        at_ns, _, i, number = offers[0]
        fates[i].append(links[i].offer(at_ns, None, frame_bytes)[0])
        heapq.heapreplace(offers, (sources[i].next_ns(at_ns, number + 1), rank[i], i, number + 1))
    for link in links:
        link.advance(end_ns)
    return [_collect(link, transits, end_ns) for link, transits in zip(links, fates)]


def _source(
    config: ChannelConfig, channel: Channel, link: Link, frame_period_ms: float | None, turn: float
) -> PeriodicArrivals | PoissonArrivals:
    """turn: in [0, 1), the part of the period by which a camera that takes turns is late."""
    if frame_period_ms is None and config.arrivals.process == "poisson":
        arrivals = channel.arrivals(link.camera, link.chain)
        assert arrivals is not None
        return arrivals
    every_ms = period_ms(config, frame_period_ms)
    return PeriodicArrivals(every_ms, turn * every_ms if config.arrivals.spread else 0.0)


def ranks(names: list[str]) -> list[int]:
    """Each camera's place in the order of names, which decides between frames of one instant."""
    return [sorted(names).index(name) for name in names]


def period_ms(config: ChannelConfig, frame_period_ms: float | None) -> float:
    """The cameras' own period."""
    return frame_period_ms or config.arrivals.period_ms or DEFAULT_FRAME_PERIOD_MS


def _frames_per_ms(config: ChannelConfig, frame_period_ms: float | None) -> float:
    """Of one camera, at most. Arrivals that only sample a camera's frames make none."""
    rates = config.arrivals.rate_per_ms
    if rates is None or frame_period_ms is not None:
        return 1 / period_ms(config, frame_period_ms)
    return max(rates) if isinstance(rates, list) else rates


def _collect(link: Link, transits: list[Transit], end_ns: int) -> LinkRun:
    def column(values: list[int | None]) -> NDArray[np.int64]:
        return np.array([-1 if v is None else v for v in values], np.int64)

    return LinkRun(
        link.camera,
        column([t.offered_ns for t in transits]),
        np.array([_CODES[t.outcome] if t.outcome else 0 for t in transits], np.int8),
        column([t.started_ns for t in transits]),
        column([t.due_ns for t in transits]),
        end_ns,
        [1.0] if link.chain is None else link.chain.occupancy(end_ns),
        link.counts[Kind.DUPLICATED],
    )


def _kernel_lacks(config: ChannelConfig, channel: Channel) -> str | None:
    """Why the kernel cannot run this channel, or None."""
    if config.faults:
        return f"faults ({', '.join(config.faults)}) are simulated by the python engine only"
    if config.chain is not None:
        probe = channel.chain or channel.chain_of("")
        if probe is not None and probe.white:
            return "a chain this fast is simulated by the python engine only"
    try:
        import numba  # noqa: F401
    except ImportError:
        return "numba is not installed (pip install 'freshfield[emu]')"
    return None


def _mean(values: list[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None
