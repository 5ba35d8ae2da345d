"""Freshest-k: a fixed number of views, the youngest ones."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow, positive_int

DEFAULT_K = 6


class FreshestK(Policy):
    name = "freshest-k"
    parameter = "k"
    value: int

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = positive_int(value, DEFAULT_K, "k")

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return freshest(epoch, self.value)


def freshest(epoch: Epoch, count: int) -> tuple[str, ...]:
    """The ``count`` cameras with the youngest frames; ties go by the cameras' own order."""
    order = sorted(epoch.generated_ns, key=lambda c: -epoch.generated_ns[c])
    chosen = set(order[:count])
    return tuple(c for c in epoch.generated_ns if c in chosen)
