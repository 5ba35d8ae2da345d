"""Round-robin: the next k cameras in turn, whether their frames are fresh or not."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow, positive_int

DEFAULT_K = 6


class RoundRobin(Policy):
    name = "round-robin"
    parameter = "k"
    value: int

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = positive_int(value, DEFAULT_K, "k")
        self._next = 0

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        cameras = tuple(epoch.generated_ns)
        if not cameras:
            return ()
        count = min(self.value, len(cameras))
        chosen = {(self._next + i) % len(cameras) for i in range(count)}
        self._next = (self._next + count) % len(cameras)
        return tuple(c for i, c in enumerate(cameras) if i in chosen)
