"""Periodic: use all views, but only at multiples of a period; what most systems do today."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan, non_negative

DEFAULT_PERIOD_MS = 1000.0


class Periodic:
    name = "periodic"
    parameter = "period_ms"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = non_negative(value, DEFAULT_PERIOD_MS, "period_ms")

    def plan(self, epoch: Epoch) -> Plan:
        """Wait for the next multiple of the period; a multiple that passed during the last fit is skipped,
        never caught up with."""
        period_ns = round(self.value * 1e6)
        if period_ns == 0:
            return Plan(epoch.now_ns)
        return Plan(epoch.now_ns, wait_until_ns=-(-epoch.now_ns // period_ns) * period_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        return tuple(epoch.generated_ns)
