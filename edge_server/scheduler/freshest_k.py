"""Freshest-k: a fixed number of views, the youngest there are."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan, freshest, positive_int

DEFAULT_K = 6


class FreshestK:
    name = "freshest-k"
    parameter = "k"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self._k = positive_int(value, DEFAULT_K, "k")

    @property
    def value(self) -> float | None:
        return self._k

    def plan(self, epoch: Epoch) -> Plan:
        return Plan(epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        return freshest(epoch, self._k)
