"""Simulates the links in virtual time: thousands of camera-seconds in a moment, from one seed.

Two engines make the same decision for every frame: ``python`` runs ``link.Link`` in an event loop, ``kernel``
(numba) computes whole arrays. Faults other than loss need ``python``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from channel_emu.model import ages
from channel_emu.model.channel import Channel
from channel_emu.model.config import ChannelConfig
from channel_emu.model.link import MAX_SIZE_BYTES
from channel_emu.virtual import python_engine
from channel_emu.virtual.link_run import OUTCOMES, LinkRun, camera_period_ms

_MOST_FRAMES = 1e9
_MOST_CAMERAS = 10_000  # 25 kB each, and ten times as many as a scenario has


class SimulationError(ValueError):
    """A simulation that cannot be run; the message says why."""


@dataclass(frozen=True)
class Simulation:
    """A finished simulation. engine: that was used. runs: one a camera, in the order of the cameras."""

    config: ChannelConfig
    seed: int
    seconds: float
    slot_ms: float
    engine: str
    runs: list[LinkRun] = field(repr=False)

    def omega(self, at_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """The set Omega(t) (thesis 5.4, 6.2): generation time of each camera's newest delivered frame, int64
        ns (T, cameras); -1 before its first delivery.

        at_ns: instants (T,) in any order; a frame delivered at an instant counts at that instant.
        """
        at = np.asarray(at_ns, np.int64)
        return np.stack([ages.newest_at(run.sawtooth(), at) for run in self.runs], -1)

    def ages_ms(self, at_ns: NDArray[np.int64]) -> NDArray[np.float64]:
        """Ages (T, cameras) in ms at the instants ``at_ns`` (T,); NaN before a camera's first delivery
        (5.5)."""
        born_ns = self.omega(at_ns)
        return np.where(born_ns >= 0, (np.asarray(at_ns, np.int64)[..., None] - born_ns) / 1e6, np.nan)

    def mean_age_ms(self) -> float | None:
        """Continuous time average of the age, over the cameras that had a delivery; None if none had."""
        return ages.mean_of_known([ages.mean_age_ms(run.sawtooth()) for run in self.runs])

    def summary(self, metrics: Sequence[str] = ()) -> dict[str, Any]:
        """Results as plain values, as the command prints them with --json.

        metrics: further age metrics (see ``ages.measure``), each averaged over the cameras that have a value.
        Raises SpellingError for an unknown one.
        """
        saws = [run.sawtooth() for run in self.runs]
        delays = np.concatenate([run.delays_ms() for run in self.runs])
        share = np.mean([run.state_share for run in self.runs], 0)
        counts = {name: sum(run.count(name) for run in self.runs) for name in OUTCOMES}
        return {
            "mean_age_ms": ages.mean_of_known([ages.mean_age_ms(s) for s in saws]),
            "mean_age_slotted_ms": ages.mean_of_known([ages.query_age_ms(s, self.slot_ms) for s in saws]),
            "peak_age_ms": ages.mean_of_known([ages.peak_age_ms(s) for s in saws]),
            "metrics_ms": {
                text: ages.mean_of_known(
                    [ages.measure(text, saw, self.seed, run.camera) for saw, run in zip(saws, self.runs)]
                )
                for text in metrics
            },
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
            "engine": self.engine,
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
    engine: str = "auto",
    frame_period_ms: float | None = None,
    frame_bytes: int = 20_000,
    slot_ms: float = 1.0,
    threads: int | None = None,
) -> Simulation:
    """Run every camera's link for ``seconds`` of virtual time.

    cameras: their number (cam00, cam01, ...) or their names.
    engine: auto (kernel if it supports the channel), python or kernel.
    frame_period_ms: the cameras' capture period. None: Poisson arrivals generate the frames (arrival =
        capture, as in the thesis). Given: they sample the camera's newest frame, as the live emulator does.
    frame_bytes: size of every frame, for faults that depend on it.
    slot_ms: slot length of the slotted mean age (5.2).
    threads: of the kernel engine; None uses every processor if the run is long enough. Results do not depend
        on it.
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
    why_not = _kernel_unsupported(config)
    if engine == "kernel" and why_not:
        raise SimulationError(f"engine kernel: {why_not}")
    if engine == "auto":
        engine = "python" if why_not else "kernel"
    if engine == "kernel":
        from channel_emu.virtual import kernel_engine

        runs = kernel_engine.run(config, channel, names, end_ns, frame_period_ms, threads)
    elif engine == "python":
        runs = python_engine.run(config, channel, names, end_ns, frame_period_ms, frame_bytes)
    else:
        raise SimulationError(f"engine: expected auto, python or kernel, got {engine!r}")
    return Simulation(config, seed, seconds, slot_ms, engine, runs)


def _frames_per_ms(config: ChannelConfig, frame_period_ms: float | None) -> float:
    """Upper bound of one camera's rate of frames. Arrivals that sample a camera's frames generate none."""
    rates = config.arrivals.rate_per_ms
    if rates is None or frame_period_ms is not None:
        return 1 / camera_period_ms(config, frame_period_ms)
    return max(rates) if isinstance(rates, list) else rates


def _kernel_unsupported(config: ChannelConfig) -> str | None:
    """The reason why the kernel engine cannot run this channel, or None."""
    if any(name != "loss" for name in config.faults):
        return f"faults ({', '.join(config.faults)}) are simulated by the python engine only"
    try:
        import numba  # noqa: F401
    except ImportError:
        return "numba is not installed (pip install 'freshfield[emu]')"
    return None
