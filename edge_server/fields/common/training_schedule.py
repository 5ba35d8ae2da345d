"""What changes from step to step: random stream, active levels, step length, and when a fit is over."""

from __future__ import annotations

import statistics
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from edge_server.fields import Budget
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.settings import TrainerSettings


def step_key(seed: int, step: int) -> np.uint64:
    """The random stream of one step."""
    return np.random.SeedSequence([seed, step]).generate_state(1, np.uint64)[0]


def step_length(settings: TrainerSettings, step: int) -> float:
    """Distance between a ray's samples in scene units: long at first, while there is only fog."""
    first = min(settings.samples_start, settings.samples)
    done = min(step / settings.samples_ramp, 1.0)
    return 2.0 * float(np.sqrt(3.0)) / (first + done * (settings.samples - first))


class StepTimer:
    """How long a step of one kind takes: the median of the latest ones, so that one hiccup changes nothing;
    0 before the first. Kept from one fit to the next."""

    def __init__(self) -> None:
        self._latest_s: deque[float] = deque(maxlen=tuned.STEP_TIMES)

    @property
    def seconds(self) -> float:
        return statistics.median(self._latest_s) if self._latest_s else 0.0

    def add(self, seconds: float) -> None:
        """Record the duration of one more step."""
        self._latest_s.append(seconds)

    def drop_longest(self) -> None:
        """Forget the longest: an estimate that lets no step begin would otherwise never be corrected."""
        if self._latest_s:
            self._latest_s.remove(max(self._latest_s))


class StepBudget:
    """Divides a budget into steps; seconds count from the making of this object.

    A step begins only if a usual one still fits; the first one may end a tenth late. If not even that fits,
    the estimate of a step is lowered, so that some later fit makes a step and ends late.

    now: returns the seconds of a clock.
    """

    def __init__(self, budget: Budget, now: Callable[[], float] = time.perf_counter) -> None:
        self._budget, self._now = budget, now
        self._start = self._step_start = now()
        self._timer: StepTimer | None = None
        self._made: set[StepTimer] = set()
        self._from: dict[StepTimer, float] = {}  # what was spent when steps of a kind began
        self.steps = 0

    def elapsed_s(self) -> float:
        """Seconds since the beginning."""
        return self._now() - self._start

    def has_room(self, seconds: float, share: float, then_s: float) -> bool:
        """Whether to begin something that usually takes ``seconds``: at most ``share`` of the budget, and
        ``then_s`` still fit behind it. A budget in steps has room for everything."""
        whole = self._budget.seconds
        return whole is None or (seconds <= share * whole and self.elapsed_s() + seconds + then_s <= whole)

    def within(self, share: float) -> bool:
        """Whether less than a share of the budget is spent; always of a budget in steps."""
        whole = self._budget.seconds
        return whole is None or self.elapsed_s() < share * whole

    def begin_step(self, timer: StepTimer) -> float | None:
        """Begin a step, unless the budget is spent: then None. Returns the progress in [0, 1] through the
        part of the budget that was left when the first step of this kind began.

        timer: that of this kind of step; ``end_step`` adds to it.
        """
        self._step_start, self._timer = self._now(), timer
        if self._budget.steps is not None:
            left = self.steps < self._budget.steps
            return self._progress(timer, self.steps, self._budget.steps) if left else None
        assert self._budget.seconds is not None
        spent, first = self._step_start - self._start, timer not in self._made
        most = self._budget.seconds * (tuned.LATE if first else 1.0)
        if spent + timer.seconds <= most:
            return self._progress(timer, spent, self._budget.seconds)
        if first:
            timer.drop_longest()
        return None

    def _progress(self, timer: StepTimer, spent: float, whole: float) -> float:
        begun = self._from.setdefault(timer, spent)
        return min((spent - begun) / (whole - begun), 1.0) if whole > begun else 1.0

    def end_step(self) -> None:
        """The step is made."""
        assert self._timer is not None
        self._timer.add(self._now() - self._step_start)
        self._made.add(self._timer)
        self.steps += 1
