"""The static field: Gaussians trained on plates alone, in one schedule, and again where plates change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.splat.kernels.optimizer_step import AdamParameters
from edge_server.fields.splat.still_field import StillField

Arrays = dict[str, NDArray]

SCHEDULE = 1600  # steps of the first schedule, in which the field grows
ROUND = 10  # steps of a round, over which rates fall; its parameters enter the mean
ROUNDS_FIRST, RATE_FIRST = 60, 0.05  # after the schedule; least weight of a round in the mean
ROUNDS_AGAIN, RATE_AGAIN = 20, 0.1  # where plates have changed
CHANGED = 8.0  # of 255, after blurring: a plate that differs more from what was learned has changed
CHANGED_PIXELS = 40  # a camera, above which the field is trained again


class PlateImage(NamedTuple):
    """A plate as it was at one moment.

    view: the camera's first frame. color: float32 (H, W, 3), at the cameras' common exposure, steps of 255.
    known: bool (H, W), where there is a plate.
    """

    view: View
    color: NDArray[np.float32]
    known: NDArray[np.bool_]


class StaticField(StillField):
    """A field of what stands still. ``learn`` says from which plates; ``train`` spends steps on them.

    Nothing of motion is part of it: nothing is tracked, removed or seeded. The first schedule is one descent
    of the learning rates, however many fits it is spread over. Afterwards the number of Gaussians stays and
    parameters are averaged, over rounds of steps.
    """

    def reset(self) -> None:
        """Forget everything, the schedule included."""
        super().reset()
        self.rounds, self._rounds_wanted, self._rate = 0, ROUNDS_FIRST, RATE_FIRST
        self._round_step = 0  # steps of this round
        self._grows_until = SCHEDULE  # step
        self._mean: NDArray[np.float32] | None = None
        self._learned: dict[str, tuple[NDArray, NDArray]] = {}  # camera -> plate, known: as learned

    @property
    def finished(self) -> bool:
        """Whether there is nothing more to learn from these plates."""
        return self.rounds >= self._rounds_wanted

    def learn(self, plates: Sequence[PlateImage]) -> None:
        """Take plates as what to learn. What is not known has no weight."""
        views = []
        for view, color, known in plates:
            image = np.clip(color + 0.5, 0, 255).astype(np.uint8)
            views.append(replace(view, image=image, weight=known.astype(np.float32)))
            self._learned[view.camera] = (color, known)
        with self._lock:
            self._ingest(views)

    def learn_again(self, plates: Sequence[PlateImage]) -> bool:
        """``learn`` if the plates have changed since, and begin rounds of training. Returns whether."""
        if sum(self._changed_pixels(plate) for plate in plates) <= CHANGED_PIXELS * len(plates):
            return False
        self.learn(plates)
        self.rounds, self._rounds_wanted, self._rate = 0, ROUNDS_AGAIN, RATE_AGAIN
        self._round_step, self._mean = 0, None
        return True

    def refine(self, plates: Sequence[PlateImage]) -> None:
        """``learn`` the same plates at a higher resolution, in what is left of the schedule, or in its second
        half again."""
        self.learn(plates)
        self._grows_until = max(SCHEDULE, self.step + SCHEDULE // 2)
        self.rounds, self._rounds_wanted, self._rate = 0, ROUNDS_FIRST, RATE_FIRST
        self._round_step, self._mean = 0, None

    def _changed_pixels(self, plate: PlateImage) -> int:
        if plate.view.camera not in self._learned:
            return int(plate.known.sum())
        before, was_known = self._learned[plate.view.camera]
        if was_known.shape != plate.known.shape:
            return int(plate.known.sum())
        both = plate.known & was_known
        differs = cv2.blur(cv2.absdiff(plate.color, before) * both[..., None], (3, 3)).max(axis=2) > CHANGED
        return int((plate.known & (differs | ~was_known)).sum())

    def train(self, pace: StepBudget) -> tuple[float, int, int]:
        """Spend what is left of a budget, or less where all is learned. Returns mean loss of the last steps,
        pixels, and pairs of a Gaussian and a tile."""
        losses: list[float] = []
        rays = samples = 0
        while not self.finished and pace.begin_step(self._step_time) is not None:
            with self._lock:
                left = self._grows_until - self.step
                growing = left > 0
                progress = 1.0 - left / SCHEDULE if growing else self._round_step / ROUND
                loss, seen, pairs, lost = self._one_step(progress)
                self.dropped += lost
                if not growing:
                    self._finish_round_step()
            if loss is not None:
                losses.append(loss)
            rays, samples = rays + seen, samples + pairs
            pace.end_step()
        return float(np.mean(losses[-32:])) if losses else 0.0, rays, samples

    def _finish_round_step(self) -> None:
        self._round_step += 1
        if self._round_step < ROUND:
            return
        self._round_step = 0
        params = self.cloud.params
        if self._mean is None:
            self._mean = params.copy()
        else:
            self._mean += (params - self._mean) * np.float32(max(1.0 / (self.rounds + 1), self._rate))
        self.rounds += 1
        if self.finished:
            self.cloud.params[:] = self._mean
            self._mean = None
            self._snapshot = None

    def shown_params(self) -> NDArray[np.float32]:
        """Parameters to render, copied: their mean where there is one."""
        with self._lock:
            return (self.cloud.params if self._mean is None else self._mean).copy()

    def moving_parameters(self, progress: float) -> AdamParameters:
        """Parameters of an optimizer step of the moving set."""
        return self.adam_parameters(progress)

    def state(self) -> Arrays:
        """Everything needed to resume bit for bit."""
        counters = [
            self.rounds,
            self._rounds_wanted,
            self._round_step,
            int(self._rate == RATE_AGAIN),
            self._grows_until,
        ]
        mine: Arrays = {"rounds": np.array(counters, np.int64)}
        if self._mean is not None:
            mine["mean"] = self._mean.copy()
        for k, (camera, (plate, known)) in enumerate(self._learned.items()):
            mine |= {f"learned_{k}.camera": np.array(camera), f"learned_{k}.plate": plate, f"learned_{k}.known": known}
        return {**super().state(), **mine}

    def load_state(self, state: Arrays) -> None:
        """Resume from ``state``."""
        super().load_state(state)
        self.rounds, self._rounds_wanted, self._round_step, again, self._grows_until = (int(n) for n in state["rounds"])
        self._rate = RATE_AGAIN if again else RATE_FIRST
        self._mean = np.array(state["mean"]) if "mean" in state else None
        self._learned = {}
        while (key := f"learned_{len(self._learned)}") + ".camera" in state:
            camera = str(state[f"{key}.camera"])
            self._learned[camera] = (np.array(state[f"{key}.plate"]), np.array(state[f"{key}.known"]))
        with self._lock:
            views = [replace(v, weight=self._learned[v.camera][1].astype(np.float32)) for v in self.view_store.views]
            if views:
                self._ingest(views)

    # --- inside -------------------------------------------------------------------------------

    def _finish_step(self) -> None:
        if self.step < self._grows_until:
            super()._finish_step()
        else:
            self.step += 1
