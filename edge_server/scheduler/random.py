"""Random: a uniformly random set of views; the baseline that the thesis's figures lack."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler import Epoch, Plan, positive_int


class RandomSubset:
    """Every non-empty subset is equally likely, or, with a value, every subset of k cameras."""

    name = "random"
    parameter = "k"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        self._size = None if value is None else positive_int(value, 1, "k")
        self._rng = rng

    @property
    def value(self) -> float | None:
        return self._size

    def plan(self, epoch: Epoch) -> Plan:
        return Plan(epoch.now_ns)

    def select(self, epoch: Epoch, plan: Plan) -> tuple[str, ...]:
        cameras = tuple(epoch.generated_ns)
        if not cameras:
            return ()
        if self._size is not None:
            count = min(self._size, len(cameras))
            chosen = set(self._rng.choice(len(cameras), size=count, replace=False).tolist())
            return tuple(c for i, c in enumerate(cameras) if i in chosen)
        while True:  # redrawing the empty set keeps the others equally likely
            keep = self._rng.random(len(cameras)) < 0.5
            if keep.any():
                return tuple(c for c, k in zip(cameras, keep) if k)
