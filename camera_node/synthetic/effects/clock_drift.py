"""Clock drift: the node's clock is offset from the true time and runs at another rate."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters
from freshfield.settings import within


class ClockDrift(EffectParameters, frozen=True):
    """node = true + offset + drift * (true - start), where start is the time of the first call."""

    offset_ms: Annotated[float, within(-1e10, 1e10, "offset of every camera's clock")] = 0.0
    drift_ppm: Annotated[float, within(-1e5, 1e5, "drift of every camera's clock")] = 0.0
    offset_spread_ms: Annotated[
        float, within(0.0, 1e9, "standard deviation of what each camera adds to the offset")
    ] = 0.0
    drift_spread_ppm: Annotated[float, within(0.0, 1e4, "standard deviation of what each camera adds to the drift")] = (
        0.0
    )

    kind: ClassVar[str] = "clock"

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
