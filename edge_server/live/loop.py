"""The thread that updates the field on the wall clock: decide, wait, fit, publish, and again."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from queue import Empty, Queue

from edge_server.fields import Budget, FitReport, Snapshot, View
from edge_server.fields.compiling import told
from edge_server.live import live_constants as tuned
from edge_server.live.field_updater import FieldUpdater, Selection
from edge_server.live.state import Controls, Publication
from freshfield.clock import Clock

log = logging.getLogger(__name__)


class UpdateLoop:
    """Runs ``updater`` on the wall clock until stopped.

    grace_ms: how long the first update waits for cameras that have not reported.
    on_published(publication, renderer, views): called after each update, on the loop's thread.
    on_status(line): reports what the loop is doing.
    on_checkpoint(path): writes the field, between two updates.
    on_event(what): reports that an operator's change took effect.
    controls: operators' changes, which take effect with the next decision.
    update_ms: fitting time of an update, whatever the rest of it takes.
    """

    def __init__(
        self,
        updater: FieldUpdater,
        clock: Clock,
        controls: Controls,
        update_ms: float,
        grace_ms: float,
        on_published: Callable[[Publication, Snapshot, list[View]], None],
        on_status: Callable[[str], None],
        on_checkpoint: Callable[[Path], None],
        on_event: Callable[[str], None],
    ) -> None:
        self._updater = updater
        self._clock = clock
        self._controls = controls
        self.update_ms = update_ms
        self._grace_ns = round(grace_ms * 1e6)
        self._on_published = on_published
        self._on_status = on_status
        self._on_checkpoint = on_checkpoint
        self._on_event = on_event
        self._checkpoints: Queue[tuple[Path, Future[Path]]] = Queue()
        self._stop = threading.Event()
        self._paused = False
        self.without_step = 0  # updates without time for a step
        self._too_short: deque[bool] = deque(maxlen=tuned.TOO_SHORT_OF)
        self._warned_short_s = float("-inf")
        self._warned_of = (0, 0, clock.now_ns() / 1e9)  # frames shed and arrived, and when
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._main, name="loop", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = tuned.STOP_S) -> None:
        """Ask the loop to end after the current update, and wait up to ``timeout_s`` for it; ``alive`` says
        whether it still runs."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    @property
    def _policy_changed(self) -> bool:
        return self._controls.chosen not in (None, self._updater.policy)

    def request_checkpoint(self, path: Path) -> Future[Path]:
        """Ask for a checkpoint at ``path``, written between two updates. The future returns the path, or
        raises the error (OSError: it could not be written)."""
        future: Future[Path] = Future()
        self._checkpoints.put((path, future))
        return future

    def _main(self) -> None:
        try:
            with told(self._on_status):
                self._on_status("loading the field's kernels")
                self._updater.field.warm_up(len(self._updater.buffer.cameras))
                self._await_cameras()
                while not self._stop.is_set():
                    self._update_once()
        except BaseException as error:  # the server raises it and ends
            log.exception("the update loop failed")
            self.failure = error

    def _await_cameras(self) -> None:
        """Give every camera a chance to report, so that the first fit does not miss half of them."""
        arrivals, first_ns = 0, None
        wanted = len(self._updater.buffer.cameras)
        while not self._stop.is_set():
            reported = len(self._updater.buffer.newest())
            now_ns = self._clock.now_ns()
            if reported and first_ns is None:
                first_ns = now_ns
            if reported == wanted or (first_ns is not None and now_ns - first_ns > self._grace_ns):
                return
            self._on_status(f"waiting for training cameras: {reported} of {wanted} have reported")
            arrivals = self._updater.buffer.wait(arrivals, tuned.LONGEST_SLEEP_S)

    def _update_once(self) -> None:
        self._apply_controls()
        if self._controls.paused != self._paused:
            self._paused = self._controls.paused
            self._on_event(f"an operator {'paused updates' if self._paused else 'resumed'}")
        if self._paused:
            self._updater.buffer.keep_every_frame(False)  # frames that arrive meanwhile do not count as shed
            self._on_status("paused")
            self._stop.wait(tuned.LONGEST_SLEEP_S)
            return
        budget = Budget(seconds=self.update_ms / 1e3)
        selection = self._select(budget)
        if selection is None:
            return
        learning = getattr(self._updater.field, "learning", "")
        self._on_status(learning or f"fitting {len(selection.items)} views")
        fitted = self._updater.fit(selection, budget)
        if fitted is None:
            self._stop.wait(tuned.ALL_DAMAGED_S)
            return
        views, report = fitted
        self._warn_of_haste(report)
        renderer = self._updater.field.snapshot(present_ns=self._clock.now_ns())
        publication = self._updater.publication(selection, views, report, self._clock.now_ns())
        self._on_published(publication, renderer, views)

    def _apply_controls(self) -> None:
        if self._policy_changed:
            self._updater.policy = self._controls.chosen  # type: ignore[assignment]
            value = "" if self._controls.value is None else f" {self._controls.value:g}"
            self._on_event(f"an operator chose the policy {self._controls.policy}{value}")
        if self._controls.reset_requested:
            self._controls.reset_requested = False
            self._updater.reset()
            log.info("the field was reset")
            self._on_event("an operator reset the field")
        self._write_checkpoints()

    def _warn_of_haste(self, report: FitReport) -> None:
        """Log occasionally how many updates made no step, and how many frames were left out, for lack of time."""
        self.without_step += report.short
        self._too_short.append(report.short)
        buffer, now_s = self._updater.buffer, self._clock.now_ns() / 1e9
        if sum(self._too_short) >= tuned.TOO_SHORT and now_s - self._warned_short_s >= tuned.WARN_EVERY_S:
            self._warned_short_s = now_s
            log.warning(
                "%d of %d updates made no step: taking in new images used up their time. Send smaller ones "
                "(source.scale, or width and height), or give updates more time (edge.update_ms)",
                sum(self._too_short),
                len(self._too_short),
            )
        shed, arrived, since_s = self._warned_of
        if now_s - since_s < tuned.WARN_EVERY_S:
            return
        self._warned_of = (buffer.shed, buffer.arrivals, now_s)
        if buffer.shed > shed:
            log.warning(
                "%d of %d frames were left out, mostly the oldest, for lack of time. Fewer or smaller "
                "ones (source.fps; source.scale, or width and height) or longer updates (edge.update_ms) help",
                buffer.shed - shed,
                buffer.arrivals - arrived,
            )

    def _write_checkpoints(self) -> None:
        while True:
            try:
                path, future = self._checkpoints.get_nowait()
            except Empty:
                return
            try:
                self._on_checkpoint(path)
                future.set_result(path)
            except OSError as error:  # a full disk must not end the updates; whoever asked gets the error
                log.error("checkpoint %s not written: %s", path, error)
                future.set_exception(error)
            except BaseException as error:  # of the field itself: it ends the loop
                future.set_exception(error)
                raise

    def _select(self, budget: Budget) -> Selection | None:
        """Plan, wait as the plan says, and select; None if the controls changed or the loop was stopped."""
        plan = self._updater.plan(self._clock.now_ns())
        arrivals = self._updater.buffer.arrivals
        while not self._stop.is_set():
            now_ns = self._clock.now_ns()
            selection = self._updater.select(plan, now_ns, budget)
            if selection is not None:
                return selection
            changed = self._controls.paused or self._controls.reset_requested or self._policy_changed
            if changed or not self._checkpoints.empty():
                return None
            left_s = (plan.wait_until_ns - now_ns) / 1e9
            if left_s > 0:
                self._stop.wait(min(left_s, tuned.LONGEST_SLEEP_S))
            else:
                self._on_status("waiting for a frame that qualifies")
                arrivals = self._updater.buffer.wait(arrivals, tuned.LONGEST_SLEEP_S)
        return None
