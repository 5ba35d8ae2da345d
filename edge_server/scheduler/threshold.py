"""omega-threshold (6.12-6.14): at every epoch, the newest frame of each camera that is no older than omega.

If none is young enough the youngest is taken all the same, so that K_t >= 1.
"""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan, freshest, non_negative

DEFAULT_OMEGA_MS = 120.0


class Threshold:
    name = "threshold"
    parameter = "omega_ms"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = non_negative(value, DEFAULT_OMEGA_MS, "omega_ms")

    def plan(self, epoch: Epoch) -> Plan:
        return Plan(epoch.now_ns, omega_ms=self.value)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        young = tuple(c for c in epoch.generated_ns if epoch.age_ms(c) <= self.value)
        return young or freshest(epoch, 1)
