"""Clock drift: the node's clock is offset from the true time and runs at another rate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from camera_node.bounds import bounded
from camera_node.synthetic.effects import EffectParameters


@dataclass(frozen=True)
class ClockDrift(EffectParameters):
    """node = true + offset + drift * (true - start), where start is the time of the first call.

    offset_ms, drift_ppm: of every camera's clock. offset_spread_ms, drift_spread_ppm: standard deviations
    of what each camera adds to them, so that cameras disagree."""

    offset_ms: float = bounded(0.0, -1e10, 1e10)  # four months
    drift_ppm: float = bounded(0.0, -1e5, 1e5)
    offset_spread_ms: float = bounded(0.0, 0.0, 1e9)
    drift_spread_ppm: float = bounded(0.0, 0.0, 1e4)

    kind = "clock"

    def start(self, rng: np.random.Generator) -> DriftingClock:
        return DriftingClock(self, rng)


class DriftingClock:
    """One camera's clock. offset_ns, drift_ppb: its errors.

    Times are whole nanoseconds, because a float64 holds today's time only to 256 ns. A call takes well under
    a microsecond.
    """

    def __init__(self, parameters: ClockDrift, rng: np.random.Generator) -> None:
        offset, drift = rng.standard_normal(2)
        self.offset_ns = round((parameters.offset_ms + parameters.offset_spread_ms * float(offset)) * 1e6)
        ppm = parameters.drift_ppm + parameters.drift_spread_ppm * float(drift)
        self.drift_ppb = round(max(-2e5, min(2e5, ppm)) * 1e3)
        self._start_ns: int | None = None

    def node_ns(self, true_ns: int) -> int:
        true_ns = int(true_ns)
        if self._start_ns is None:
            self._start_ns = true_ns
        return true_ns + self.offset_ns + (true_ns - self._start_ns) * self.drift_ppb // 10**9
