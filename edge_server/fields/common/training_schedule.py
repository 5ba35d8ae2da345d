"""What changes from step to step: random stream, active levels, learning rate, and when a fit is over."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from edge_server.fields import Budget
from edge_server.fields.common.trainer_settings import TrainerSettings
from edge_server.fields.ngp.settings import NgpSettings

BETA1, BETA2 = 0.9, 0.99
# Of encodings and their networks: a first fit has a hundred steps or so, and with .9 a tenth of them pass
# before Adam lets go of gradients of a fog that is gone.
BETA1_FIELD = 0.65
# The smoothness prior goes through whole levels: now and then, and stronger for it, does as well.
SMOOTH_EVERY = 4
LATE = 1.1  # of a budget in seconds: so late may a fit end rather than make no step
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


class Usual:
    """How long a step of one kind takes: the median of the latest, which one hiccup does not move; 0 before
    the first. Kept from one fit to the next."""

    def __init__(self) -> None:
        self._latest_s: deque[float] = deque(maxlen=5)

    @property
    def seconds(self) -> float:
        return statistics.median(self._latest_s) if self._latest_s else 0.0

    def took(self, seconds: float) -> None:
        """Learn of one more."""
        self._latest_s.append(seconds)

    def doubt(self) -> None:
        """Forget the longest: what lets no step begin would otherwise never be found to be wrong."""
        if self._latest_s:
            self._latest_s.remove(max(self._latest_s))


class Pace:
    """Divides a budget into steps. A budget in seconds counts from the making of this object; a step begins
    only if a usual one still fits, the first one if it ends a tenth late at most. Fits too short for any step
    make one now and then, and end later.

    now: seconds of a clock.
    """

    def __init__(self, budget: Budget, now: Callable[[], float] = time.perf_counter) -> None:
        self._budget, self._now = budget, now
        self._start = self._began = now()
        self._kind: Usual | None = None
        self._made: set[Usual] = set()
        self.steps = 0

    def seconds(self) -> float:
        """Seconds since the beginning."""
        return self._now() - self._start

    def has_room(self, seconds: float, share: float, then_s: float) -> bool:
        """Whether something may be done that usually takes ``seconds``: not above that share of the budget,
        and ``then_s`` still fit behind it. A budget in steps has room for everything."""
        whole = self._budget.seconds
        return whole is None or (seconds <= share * whole and self.seconds() + seconds + then_s <= whole)

    def begin(self, usual: Usual, then_s: float = 0.0) -> float | None:
        """Progress of the fit in [0, 1] at which the next step is made; None when the budget is spent.

        usual: of this kind of step, told of it by ``end``. then_s: what has to follow within the budget."""
        self._began, self._kind = self._now(), usual
        if self._budget.steps is not None:
            return None if self.steps >= self._budget.steps else self.steps / self._budget.steps
        assert self._budget.seconds is not None
        spent, first = self._began - self._start, usual not in self._made
        most = self._budget.seconds * (LATE if first and not then_s else 1.0)
        if spent + usual.seconds + then_s <= most:
            return min(spent / self._budget.seconds, 1.0) if self._budget.seconds else 1.0
        if first:
            usual.doubt()
        return None

    def end(self) -> None:
        """The step is made."""
        assert self._kind is not None
        self._kind.took(self._now() - self._began)
        self._made.add(self._kind)
        self.steps += 1
