"""What changes from step to step: random stream, active levels, learning rate, and when a fit is over."""

from __future__ import annotations

import time

import numpy as np

from edge_server.fields import Budget
from edge_server.fields.ngp_settings import NgpSettings
from edge_server.fields.trainer_settings import TrainerSettings

BETA1, BETA2 = 0.9, 0.99
# The smoothness prior goes through whole levels: now and then, and stronger for it, does as well.
SMOOTH_EVERY = 4
NOMINAL_RAYS = 4096.0  # gradients are scaled as if a step had so many rays: Adam's epsilon keeps its meaning


def step_key(seed: int, step: int) -> np.uint64:
    """The random stream of one step."""
    return np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0]


def active_levels(settings: NgpSettings, step: int) -> int:
    """Levels in use: coarse to fine, so that few views cannot be explained by fine noise at once."""
    if settings.levels_every == 0:
        return settings.levels
    return min(settings.levels, settings.levels_start + step // settings.levels_every)


def smoothing(settings: NgpSettings, step: int) -> float:
    """The weight of the smoothness prior at a step, 0 for most of them."""
    return SMOOTH_EVERY * settings.smooth if step % SMOOTH_EVERY == 0 else 0.0


def step_length(settings: TrainerSettings, step: int) -> float:
    """Distance between a ray's samples in scene units: long at first, while there is only fog."""
    first = min(settings.samples_start, settings.samples)
    done = min(step / settings.samples_ramp, 1.0) if settings.samples_ramp else 1.0
    return 2.0 * float(np.sqrt(3.0)) / (first + done * (settings.samples - first))


class Pace:
    """Divides a budget into steps. A budget in seconds counts from the making of this object, and is never
    exceeded by more than one step: the next one begins only if a usual one still fits."""

    def __init__(self, budget: Budget) -> None:
        self._budget, self._start = budget, time.perf_counter()
        self._began, self._usual = self._start, 0.0
        self.steps = 0

    def seconds(self) -> float:
        """Wall seconds since the beginning."""
        return time.perf_counter() - self._start

    def begin(self) -> float | None:
        """Progress of the fit in [0, 1] at which the next step is made; None when the budget is spent."""
        self._began = time.perf_counter()
        if self._budget.steps is not None:
            return None if self.steps >= self._budget.steps else self.steps / self._budget.steps
        assert self._budget.seconds is not None
        spent = self._began - self._start
        over = spent + self._usual > self._budget.seconds
        return None if over else spent / self._budget.seconds

    def end(self) -> None:
        """The step is made."""
        took = time.perf_counter() - self._began
        # A mean, since one delayed step must not end a fit early; the first says little (cold caches).
        self._usual = 0.5 * took if self.steps == 0 else 0.8 * self._usual + 0.2 * took
        self.steps += 1
