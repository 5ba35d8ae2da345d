"""Base class of fields that learn step by step: fits within a budget, snapshots, state, compiling ahead."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, Generic, Protocol, Self, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, FitReport, Rendering, Snapshot, View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.field_state import all_or_nothing, pack_state, unpack_meta
from edge_server.fields.common.threads.fair_lock import FairLock
from edge_server.fields.common.threads.thread_pool import Pool, compile_kernels, shared_pool
from edge_server.fields.common.training_schedule import StepBudget, StepTimer
from edge_server.fields.common.view_store import Arrays, ViewStore
from freshfield.geometry import Pinhole

# A step at a progress of the fit in [0, 1] -> loss, rays, samples, and how many values were not finite and left out.
Step = Callable[[float], tuple[float, int, int, int]]


class StepSnapshot(Snapshot, Protocol):
    """The snapshot of a field at one of its steps."""

    @property
    def step(self) -> int: ...

    def at(self, present_ns: int) -> Self: ...

    def copied(self) -> Self:
        """The same with arrays of its own."""
        ...


S = TypeVar("S", bound=StepSnapshot)


class SteppedField(ABC, Generic[S]):
    """See ``fields.Field`` for the protocol.

    ``fit`` belongs to one thread; ``render`` and ``snapshot`` may be called from others meanwhile: they
    wait for the end of the present step, some milliseconds.

    Settings: the class of its settings. shape: options in which a state and the field that loads it must agree.
    """

    frame_s: float | None = None
    most_pixels = None

    shape: ClassVar[tuple[str, ...]]
    Settings: ClassVar[type]
    step: int
    _step_time: StepTimer
    _snapshot: S | None  # identified by its step alone

    def __init__(self, settings: Any = None, pool: Pool | None = None) -> None:
        """settings: of ``Settings``; None: the defaults."""
        self.settings = settings or self.Settings()
        self.pool = pool or shared_pool(self.settings.threads, self.settings.nice)
        self._lock = FairLock()
        self.now = time.perf_counter  # the clock of budgets in seconds
        self.reset()

    @property
    def views(self) -> tuple[View, ...]:
        """Newest view of each camera."""
        return self.view_store.views

    def reset(self) -> None:
        """Forget the scene, its box and its cameras; keep settings and compiled kernels."""
        with self._lock:
            self.dropped = 0
            self.view_store = ViewStore(self.settings)
            self._forget_parameters()

    def fit(self, views: Sequence[View], budget: Budget) -> FitReport:
        """Train on ``views`` from the present parameters. ValueError for an impossible view.

        New pictures are always taken in, however short the budget. With a budget in seconds, no step begins
        that would probably end too late. The learning rate falls over the budget, so that every fit ends with
        a settled field.
        """
        if not views:
            return FitReport(0, 0.0, 0.0, 0, 0, note="no views: nothing was done")
        step_budget = StepBudget(budget, self.now)
        one_step = self._begin_fit(views, step_budget)
        rays = samples = dropped = 0
        losses: deque[float] = deque(maxlen=tuned.LOSS_STEPS)
        while (progress := step_budget.begin_step(self._step_time)) is not None:
            with self._lock:
                loss, seen, used, lost = one_step(progress)
            losses.append(loss)
            rays, samples, dropped = rays + seen, samples + used, dropped + lost
            step_budget.end_step()
        self.dropped += dropped
        loss = float(np.mean(losses)) if losses else 0.0
        steps = step_budget.steps
        return FitReport(steps, step_budget.elapsed_s(), loss, rays, samples, dropped, short=steps == 0)

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """Render a camera from the present parameters."""
        return self.snapshot().render(camera_to_world, intrinsics)

    def snapshot(self, present_ns: int | None = None) -> S:
        """A copy that renders from any thread and never changes. present_ns: see ``fields.Field``."""
        with self._lock:
            if self._snapshot is None or self._snapshot.step != self.step:
                self._snapshot = self._live().copied()
            known = self._snapshot
        return known if present_ns is None else known.at(present_ns)

    def warm_up(self, cameras: int | None = None) -> float:
        """Compile (or load from numba's cache) every kernel before it is needed; returns the seconds.

        Trains small fields of its own; this field's state is not touched.
        """
        return compile_kernels(self._run_kernels)

    def state(self) -> Arrays:
        """Everything needed to go on bit for bit: what was learned, moments, cameras, counters."""
        with self._lock:
            return pack_state(self.settings, self.view_store, self._counters(), self._arrays())

    def load_state(self, state: Arrays) -> None:
        """Continue from ``state``. ValueError: it is not the state of a field of this shape."""
        with self._lock, all_or_nothing(self):
            meta = unpack_meta(self.settings, state, self.settings.name, self.shape)
            self.view_store = ViewStore(self.settings)
            self.view_store.load(meta, state)
            self._forget_parameters()
            self.step, self.dropped = int(meta["step"]), int(meta["dropped"])
            self._load(meta, state)
            self._snapshot = None

    # --- what a representation is -------------------------------------------------------------

    @abstractmethod
    def _forget_parameters(self) -> None:
        """Begin at step 0, without a snapshot, in the box of ``view_store`` (None: no scene yet)."""

    @abstractmethod
    def _begin_fit(self, views: Sequence[View], step_budget: StepBudget) -> Step:
        """Take views in, under the lock; returns a fit's step."""

    @abstractmethod
    def _live(self) -> S:
        """A snapshot of the arrays in use, not copied, for the holder of the lock."""

    @abstractmethod
    def _tiny(self) -> Any:
        """Small settings, with which ``warm_up`` compiles the kernels."""

    def _run_kernels(self, pool: Pool) -> None:
        """Run every kernel once."""
        tiny, camera, pose = self._tiny(), Pinhole.from_fov(16, 16, 60.0), np.eye(4)
        pose[2, 3] = -3.0
        for channels in (3, 4):
            field = type(self)(msgspec.structs.replace(tiny, min_views=1, contracted=channels == 3), pool)
            image = np.full((16, 16, channels), 128, np.uint8)
            image[4:8, 4:8, :3] = 255  # or there would be no Gaussians
            views = [View(f"warm-up {k}", image, pose, camera) for k in range(3)]
            field.fit(views, Budget(steps=2))  # with a depth guide, if any is to be expected
            field.render(pose, camera)

    @abstractmethod
    def _counters(self) -> dict[str, Any]:
        """Facts of the state for JSON, ``step`` and ``dropped`` among them."""

    @abstractmethod
    def _arrays(self) -> Arrays:
        """What was learned."""

    @abstractmethod
    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        """Take over the counters and arrays of a state."""
