"""Random: a uniformly random set of views; a baseline that the thesis's figures lack."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow, positive_int


class RandomSubset(Policy):
    """Every non-empty subset is equally likely, or, with a value, every subset of k cameras."""

    name = "random"
    parameter = "k"
    value: int | None

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        self.value = None if value is None else positive_int(value, 1, "k")
        self._rng = rng

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        cameras = tuple(epoch.generated_ns)
        if not cameras:
            return ()
        if self.value is not None:
            count = min(self.value, len(cameras))
            chosen = set(self._rng.choice(len(cameras), size=count, replace=False).tolist())
            return tuple(c for i, c in enumerate(cameras) if i in chosen)
        while True:  # redrawing the empty set keeps the others equally likely
            keep = self._rng.random(len(cameras)) < 0.5
            if keep.any():
                return tuple(c for c, k in zip(cameras, keep) if k)
