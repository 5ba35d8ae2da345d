"""Use all: every camera's newest frame, however old. The ceiling of views, and of age."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan


class UseAll:
    name = "all"
    parameter = None
    value: float | None = None

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del value, rng  # it has neither a parameter nor chance

    def plan(self, epoch: Epoch) -> Plan:
        return Plan(epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        return tuple(epoch.generated_ns)
