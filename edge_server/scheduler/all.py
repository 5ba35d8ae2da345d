"""Use all: every camera's newest frame, however old. The maximum of views, and of age."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow


class UseAll(Policy):
    name = "all"

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del value, rng  # no parameter, no randomness

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return tuple(epoch.generated_ns)
