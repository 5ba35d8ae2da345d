"""The static field and what it shows: trained in the caller's budget, or in a thread beside the caller."""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, Rendering, View
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.splat.kernels.project import Gaussians
from edge_server.fields.splat.layers.static_field import ROUND, PlateImage, StaticField
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.snapshot import SplatSnapshot

SHOWN_AFTER = 400  # steps, after which the static field is better than the first field
RENDER_EVERY = 400  # steps of a thread of its own, between renderings of all cameras


class StaticLayer:
    """A ``StaticField`` for one caller.

    shown: the field as it was last published. rendered: camera -> step and rendering, for the caller to take.
    Nothing waits for the thread of ``train_beside`` but ``stop``.
    """

    def __init__(self, settings: SplatSettings, pool: Pool) -> None:
        self.field = StaticField(settings, pool)
        self.shown: SplatSnapshot | None = None
        self.rendered: dict[str, tuple[int, Rendering]] = {}
        self._thread: threading.Thread | None = None
        self._stopping = False
        self._failure: BaseException | None = None

    @property
    def ready(self) -> bool:
        """Whether the field is good enough to be shown."""
        return self.shown is not None and self.shown.step >= SHOWN_AFTER

    @property
    def training(self) -> bool:
        """Whether the thread is at work. Raises what ended it early."""
        self._raise_failure()
        return self._thread is not None and self._thread.is_alive()

    def train_beside(self, plates: Sequence[PlateImage], views: Sequence[View]) -> None:
        """Learn plates that have changed, in a thread, until nothing is left to learn, and render ``views``
        meanwhile. The thread must not be at work."""
        self._stopping = False
        self._thread = threading.Thread(target=self._main, args=(plates, views), name="static-field", daemon=True)
        self._thread.start()

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

    def reset(self) -> None:
        """Forget the scene."""
        self.stop()
        self.field.reset()
        self.shown = None
        self.rendered = {}

    def publish(self) -> None:
        """Show the field as it is now; call it from the thread that trains."""
        if self.shown is not None and self.shown.step == self.field.step:
            return
        params = self.field.shown_params()
        self.shown = replace(self.field._live(), gaussians=gaussians(params, self.field.settings))

    def render(self, views: Iterable[View]) -> None:
        """Render what is shown from the cameras of ``views``."""
        shown = self.shown
        assert shown is not None
        for view in views:
            self.rendered[view.camera] = (shown.step, shown.render(view.camera_to_world, view.intrinsics))

    def _main(self, plates: Sequence[PlateImage], views: Sequence[View]) -> None:
        try:
            if self.field.finished:
                self.field.learn_again(plates)
            rendered_step = self.field.step
            while not self.field.finished and not self._stopping:
                self.field.train(StepBudget(Budget(steps=ROUND)))
                self.publish()
                due = self.field.finished or self.field.step - rendered_step >= RENDER_EVERY
                if due and self.ready:
                    self.render(views)
                    rendered_step = self.field.step
        except BaseException as error:  # the caller raises it
            self._failure = error


def gaussians(params: NDArray[np.float32], settings: SplatSettings) -> Gaussians:
    """Gaussians that do not move, of parameters float32 (N, P)."""
    return Gaussians(params, settings.harmonics)
