"""omega-threshold (6.12-6.14): at every epoch, the newest frame of each camera that is no older than
omega."""

from __future__ import annotations

import numpy as np

from edge_server.scheduler.freshest_k import freshest
from edge_server.scheduler.policy import Epoch, Policy, SelectionWindow, non_negative

DEFAULT_OMEGA_MS = 120.0


class Threshold(Policy):
    name = "threshold"
    parameter = "omega_ms"
    value: float

    def __init__(self, value: float | None, rng: np.random.Generator) -> None:
        del rng
        self.value = non_negative(value, DEFAULT_OMEGA_MS, "omega_ms")

    def plan(self, epoch: Epoch) -> SelectionWindow:
        return SelectionWindow(omega_ms=self.value)

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return within_threshold(epoch, self.value)


def within_threshold(epoch: Epoch, omega_ms: float) -> tuple[str, ...]:
    """Cameras whose newest frame is at most ``omega_ms`` old; if there is none, the freshest (K_t >= 1)."""
    young = tuple(c for c in epoch.generated_ns if epoch.age_ms(c) <= omega_ms)
    return young or freshest(epoch, 1)
