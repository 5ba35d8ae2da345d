"""Periodic: use all views, but only at multiples of a period; what most systems do today."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow, non_negative

DEFAULT_PERIOD_MS = 1000.0


class Periodic(Policy):
    name = "periodic"
    parameter = "period_ms"
    value: float

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = non_negative(value, DEFAULT_PERIOD_MS, "period_ms")

    def plan(self, epoch: Epoch) -> SelectionWindow:
        """Wait for the next multiple of the period. A multiple that passed during the last fit is skipped."""
        period_ns = round(self.value * 1e6)
        if period_ns == 0:
            return SelectionWindow()
        return SelectionWindow(wait_until_ns=-(-epoch.now_ns // period_ns) * period_ns)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return tuple(epoch.generated_ns)
