"""Round-robin: the next k cameras in turn, whether their frames are fresh or not."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan, positive_int

DEFAULT_K = 6


class RoundRobin:
    name = "round-robin"
    parameter = "k"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self._k = positive_int(value, DEFAULT_K, "k")
        self._next = 0

    @property
    def value(self) -> float | None:
        return self._k

    def plan(self, epoch: Epoch) -> Plan:
        return Plan(epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        cameras = tuple(epoch.generated_ns)
        if not cameras:
            return ()
        count = min(self._k, len(cameras))
        turns = {(self._next + i) % len(cameras) for i in range(count)}
        self._next = (self._next + count) % len(cameras)
        return tuple(c for i, c in enumerate(cameras) if i in turns)
