"""Training of the still field on background plates: in the caller's budget, or in another thread.

The first schedule is one decay of the learning rates, over any number of fits. Afterwards the number of Gaussians
stays and parameters are averaged, over rounds of steps; when plates change, the rounds restart.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, Rendering, View
from edge_server.fields.common.field_state import give_attributes, take_attributes
from edge_server.fields.common.threads.thread_pool import lower_priority
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.field_constants import LOSS_STEPS
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.snapshot import SplatSnapshot

Arrays = dict[str, NDArray]
_SCHEDULE = ("rounds", "_rounds_wanted", "_rate", "_round_step", "grows_until")
_KEPT = (*_SCHEDULE, "ready", "shown_after", "_better_than", "_error")  # of a state


class PlateImage(NamedTuple):
    """A background plate at one moment.

    view: the camera's first frame. color: float32 (H, W, 3), at the cameras' common exposure, steps of 255.
    known: bool (H, W), where there is a plate; or float32 (H, W) in [0, 1], how much each pixel counts.
    """

    view: View
    color: NDArray[np.float32]
    known: NDArray[np.bool_] | NDArray[np.float32]


class StaticLayer:
    """The static layer. ``learn`` sets its plates; ``train`` spends steps on them.

    shown: the last published field. ready: whether it is good enough to be shown, and to fill in unknown plates; reset
    by a restart. rendered: camera -> step and rendering, for the caller to take.
    Nothing waits for the thread of ``train_beside`` but ``stop`` and, for a time, ``wait``.
    """

    def __init__(self, field: StillField) -> None:
        self.field = field
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._failure: BaseException | None = None
        self.forget()

    def forget(self) -> None:
        """Forget the plates and the schedule; the field does not change."""
        self.stop()
        self.shown: SplatSnapshot | None = None
        self.ready = False
        self.rendered: dict[str, tuple[int, Rendering]] = {}
        self.grows_until = tuned.SCHEDULE  # step
        self.shown_after = tuned.SHOWN_AFTER  # steps
        self._better_than = 1.0  # mean squared error of the field shown meanwhile, relative to full scale
        self._error = 1.0  # that of the latest steps
        # Camera -> plate, known: as learned, in that order. None: a plate that is obsolete.
        self._learned: dict[str, tuple[NDArray | None, NDArray]] = {}
        self._begin_rounds(tuned.ROUNDS_FIRST, tuned.RATE_FIRST)

    def forget_camera(self, camera: str) -> None:
        """Forget a camera's learned plate, and renderings from its place."""
        self.stop()
        self.rendered.pop(camera, None)
        if camera in self._learned:
            self._learned[camera] = (None, self._learned[camera][1])

    def _begin_rounds(self, wanted: int, rate: float) -> None:
        self.rounds, self._rounds_wanted, self._rate = 0, wanted, rate
        self._round_step = 0  # steps of this round
        self._mean: NDArray[np.float32] | None = None

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to learn from these plates."""
        return self.rounds >= self._rounds_wanted

    # --- plates -------------------------------------------------------------------------------

    def begin(self, plates: Sequence[PlateImage], shown_after: int | None = None, better_than: float = 1.0) -> None:
        """``learn`` the first plates, in a schedule that begins now.

        shown_after: steps after which the field may be shown; None: SHOWN_AFTER.
        better_than: mean squared error that it must have reached then, or have had SHOWN_AT_LATEST steps.
        """
        self.learn(plates)
        self.ready, self._better_than, self._error = False, better_than, 1.0
        self.shown_after = tuned.SHOWN_AFTER if shown_after is None else shown_after
        self.grows_until = self.field.step + tuned.SCHEDULE
        self._begin_rounds(tuned.ROUNDS_FIRST, tuned.RATE_FIRST)

    def learn(self, plates: Sequence[PlateImage]) -> None:
        """Make plates the training views. Unknown pixels have no weight."""
        views, self._learned = [], {}
        for view, color, known in plates:
            image = np.clip(color + 0.5, 0, 255).astype(np.uint8)
            views.append(replace(view, image=image, weight=known.astype(np.float32)))
            self._learned[view.camera] = (color, known)
        self.field.take_in(views)

    def have_changed(self, plates: Sequence[PlateImage]) -> bool:
        """Whether plates have changed since they were learned."""
        return sum(self._changed_pixels(plate) for plate in plates) > tuned.CHANGED_PIXELS * len(plates)

    def learn_again(self, plates: Sequence[PlateImage]) -> None:
        """``learn``, and start rounds of training."""
        self.learn(plates)
        self._begin_rounds(tuned.ROUNDS_AGAIN, tuned.RATE_AGAIN)

    def refine(self, plates: Sequence[PlateImage]) -> None:
        """``learn`` the same plates at a higher resolution, in the rest of the schedule, or repeating its second
        half."""
        self.learn(plates)
        self.grows_until = max(self.grows_until, self.field.step + tuned.SCHEDULE // 2)
        self._begin_rounds(tuned.ROUNDS_FIRST, tuned.RATE_FIRST)

    def _changed_pixels(self, plate: PlateImage) -> int:
        before, was_known = self._learned.get(plate.view.camera, (None, plate.known))
        if before is None or was_known.shape != plate.known.shape:
            return int(np.count_nonzero(plate.known))
        now_known, was_known = plate.known > 0, was_known > 0
        both = now_known & was_known
        differs = cv2.blur(cv2.absdiff(plate.color, before) * both[..., None], (3, 3)).max(axis=2) > tuned.CHANGED
        return int((now_known & (differs | ~was_known)).sum())

    # --- training -----------------------------------------------------------------------------

    def train(self, pace: StepBudget) -> tuple[float, int, int]:
        """Spend the rest of a budget, or less if training is finished. Returns the mean loss of the last steps, pixels,
        and pairs of a Gaussian and a tile."""
        losses: list[float] = []
        rays = samples = 0
        while not self.finished and pace.begin_step(self.field.step_time) is not None:
            left = self.grows_until - self.field.step
            progress = 1.0 - left / tuned.SCHEDULE if left > 0 else self._round_step / tuned.ROUND
            loss, seen, pairs = self.field.train_step(progress, grow=left > 0)
            self._error += (loss - self._error) * tuned.ERROR_RATE
            if left <= 0:
                self._finish_round_step()
            losses.append(loss)
            rays, samples = rays + seen, samples + pairs
            pace.end_step()
        return float(np.mean(losses[-LOSS_STEPS:])) if losses else 0.0, rays, samples

    def _finish_round_step(self) -> None:
        self._round_step += 1
        if self._round_step < tuned.ROUND:
            return
        self._round_step = 0
        params = self.field.cloud.params
        if self._mean is None:
            self._mean = params.copy()
        else:
            self._mean += (params - self._mean) * np.float32(max(1.0 / (self.rounds + 1), self._rate))
        self.rounds += 1
        if self.finished:
            self.field.set_params(self._mean)
            self._mean = None

    def train_beside(self, begin: Callable[[], None], views: Sequence[View]) -> None:
        """Train in a thread until finished, and render ``views`` meanwhile. The thread must not be running. begin:
        called first, in the thread."""
        self._stopping = False
        self._thread = threading.Thread(target=self._main, args=(begin, views), name="static-field", daemon=True)
        self._thread.start()

    @property
    def at_work(self) -> bool:
        """Whether the thread is at work."""
        return self._thread is not None and self._thread.is_alive()

    @property
    def training(self) -> bool:
        """Whether the thread is at work. Raises what ended it early."""
        self._raise_failure()
        return self.at_work

    def wait(self, seconds: float) -> None:
        """Leave the processor to the thread for a time, or until it ends."""
        if self._thread is not None:
            self._thread.join(max(seconds, 0.0))

    def end_soon(self) -> None:
        """Make the thread end after a few steps."""
        self._stopping = True

    def stop(self) -> None:
        """End the thread after a few steps, and wait for it. Raises what ended it early."""
        self._stopping = True
        if self._thread is not None:
            self._thread.join()
        self._thread = None
        self._raise_failure()

    def _raise_failure(self) -> None:
        failure, self._failure = self._failure, None
        if failure is not None:
            failure.add_note("The static field was being trained beside the updates.")
            raise failure

    def _main(self, begin: Callable[[], None], views: Sequence[View]) -> None:
        lower_priority(self.field.pool.nice)  # on few cores this thread computes itself
        try:
            begin()
            rendered_step = self.field.step
            while not self.finished and not self._stopping:
                self.train(StepBudget(Budget(steps=tuned.ROUND)))
                self.publish()
                due = self.finished or self.field.step - rendered_step >= tuned.RENDER_EVERY
                if due and self.ready:
                    self.render(views)
                    rendered_step = self.field.step
        except BaseException as error:  # the caller raises it
            self._failure = error

    # --- what is shown ------------------------------------------------------------------------

    def publish(self) -> None:
        """Publish the current field, or the mean of its parameters if there is one; call it from the training
        thread."""
        if self.shown is None or self.shown.step != self.field.step:
            snapshot = self.field.snapshot()
            if self._mean is not None:
                snapshot = replace(snapshot, params=self._mean.copy())
            self.shown = snapshot
        fits = self._error <= self._better_than or self.shown.step >= tuned.SHOWN_AT_LATEST
        self.ready = self.ready or (fits and self.shown.step >= self.shown_after)

    def render(self, views: Iterable[View]) -> None:
        """Render the published field from the cameras of ``views``."""
        shown = self.shown
        assert shown is not None
        for view in views:
            self.rendered[view.camera] = (shown.step, shown.render(view.camera_to_world, view.intrinsics))

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed, besides the field's state, to resume bit for bit."""
        mine: Arrays = take_attributes(self, _KEPT)
        if self._mean is not None:
            mine["mean"] = self._mean.copy()
        for k, (camera, (plate, known)) in enumerate(self._learned.items()):
            mine |= {f"learned_{k}.camera": np.array(camera), f"learned_{k}.known": known}
            mine |= {} if plate is None else {f"learned_{k}.plate": plate}
        return mine

    def load_state(self, state: Arrays) -> None:
        """Resume from ``state``, with a field that has resumed already. KeyError: it lacks something."""
        give_attributes(self, _KEPT, state)
        self._mean = np.array(state["mean"]) if "mean" in state else None
        self._learned = {}
        while (key := f"learned_{len(self._learned)}") + ".camera" in state:
            camera = str(state[f"{key}.camera"])
            plate = np.array(state[f"{key}.plate"]) if f"{key}.plate" in state else None
            self._learned[camera] = (plate, np.array(state[f"{key}.known"]))
        views = {view.camera: view for view in self.field.view_store.views}
        known = {camera: known.astype(np.float32) for camera, (_, known) in self._learned.items() if camera in views}
        if known:
            self.field.take_in([replace(views[camera], weight=weight) for camera, weight in known.items()])
