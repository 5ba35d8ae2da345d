"""The loop at the edge: decision epoch -> views -> fit -> publish.

``Updates`` holds what happens and takes every time as an argument, so that studies run it in virtual time;
``Loop`` is the thread that runs it on the wall clock. The present is the instant an update is published: the
time spent fitting ages the scene as surely as the network does.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from pathlib import Path
from queue import Empty, Queue
from typing import TYPE_CHECKING

import numpy as np

from edge_server.config import KeyframesConfig
from edge_server.fields import Budget, Field, FitReport, Renderer, View
from edge_server.live.buffer import Buffered, FrameBuffer
from edge_server.live.state import Publication
from edge_server.live.update_budget import Pacing
from edge_server.live.view_decoder import Decoder
from edge_server.scheduler import STATE_PARTS, Epoch, Policy, SelectionWindow
from freshfield.clock import Clock
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:  # loaded only where a policy was learnt, or a scenario asks for it
    from edge_server.embed.cache import EmbeddingCache, Embeds
    from edge_server.foreground import ForegroundConfig
    from edge_server.foreground.foreground import Foreground
    from edge_server.live.keyframes import Keyframes
    from edge_server.scheduler.learned.state import State

log = logging.getLogger(__name__)

# How long the loop sleeps at most before it looks at the controls again.
_NAP_S = 0.2


@dataclass(frozen=True)
class Selection:
    """A finished decision: which buffered frames to use, as of ``now_ns``. earlier: where the policy treats
    what it selects, the frames that these cameras delivered before, of those that did."""

    plan: SelectionWindow
    now_ns: int
    items: tuple[Buffered, ...]
    earlier: tuple[Buffered, ...] = ()


@dataclass
class TreatmentCost:
    """What treating stale views has taken so far: views, and wall seconds (a measurement, no part of what is
    decided)."""

    views: int = 0
    seconds: float = 0.0

    @property
    def ms_per_view(self) -> float | None:
        return 1e3 * self.seconds / self.views if self.views else None


class Updates:
    """Decisions and updates of one field from one buffer. Owns no thread and reads no clock. embedder: for
    policies that look at what the cameras see; keyframes: earlier viewpoints of cameras that move;
    foreground: cuts out the object. None: there are none."""

    def __init__(
        self,
        buffer: FrameBuffer,
        policy: Policy,
        field: Field,
        start_ns: int,
        embedder: Embeds | None = None,
        keyframes: Keyframes | None = None,
        foreground: Foreground | None = None,
    ) -> None:
        self.buffer = buffer
        self.decoder = Decoder(foreground)
        self._embedder = embedder
        self.embeddings: EmbeddingCache | None = None
        if embedder is not None:
            from edge_server.embed.cache import EmbeddingCache

            # What is embedded and trained on is decoded once.
            self.embeddings = EmbeddingCache(embedder, self.decoder)
        self.expose: Callable[[Sequence[Buffered]], Sequence[Buffered]] | None = None
        """Gives frames of the buffer their pictures and poses, where these are made late (virtual time)."""
        self.policy = policy
        self.field = field
        self.keyframes = keyframes
        self.treatment_cost = TreatmentCost()
        self.start_ns = start_ns
        self.number = 0

    @property
    def policy(self) -> Policy:
        return self._policy

    @policy.setter
    def policy(self, policy: Policy) -> None:
        """From the next decision on. Only a policy that compares a camera's frames has the older one kept.
        ValueError for a policy that needs embeddings where there are none."""
        self.check(policy)
        self._policy = policy
        treats = policy.treatment is not None
        self.buffer.keep_earlier(treats)
        if not treats:
            self.decoder.forget_earlier()

    def check(self, policy: Policy) -> None:
        """ValueError where ``policy`` needs embeddings that are not computed here: there are none, or
        another embedder's than it was taught with."""
        wanted, whose = policy.embedding
        if not wanted:
            return
        if self._embedder is None:
            raise ValueError(f"{policy.name} decides by what cameras see: it needs an edge.embedding section")
        if wanted != self._embedder.dim or (whose and whose != self._embedder.name):
            raise ValueError(
                f"{policy.name} was taught with {whose or 'embeddings'} of {wanted} numbers, edge.embedding "
                f"is {self._embedder.name} of {self._embedder.dim}"
            )

    def epoch(self, now_ns: int) -> Epoch:
        return self._epoch(self.buffer.newest(), now_ns)

    def _epoch(self, newest: Mapping[str, Buffered], now_ns: int) -> Epoch:
        def state(parts: Sequence[str] = STATE_PARTS) -> State:
            from edge_server.scheduler.learned.observation import observe

            seen = newest
            if self.expose is not None:
                seen = {item.frame.camera: item for item in self.expose(tuple(newest.values()))}
            return observe(self.buffer.cameras, seen, now_ns, self.embeddings, parts, keep_frames=True)

        generated = {c: item.generated_ns for c, item in newest.items()}
        return Epoch(now_ns, self.number, generated, state)

    def plan(self, now_ns: int) -> SelectionWindow:
        return self.policy.plan(self.epoch(now_ns))

    def select(self, plan: SelectionWindow, now_ns: int) -> Selection | None:
        """What the plan's policy admits of the buffer as it is at ``now_ns``; None: wait on."""
        if now_ns < plan.wait_until_ns:
            return None
        newest, earlier = self.buffer.newest_and_earlier()
        cameras = self.policy.select(self._epoch(newest, now_ns), plan)
        if not cameras:
            return None
        before = tuple(earlier[c] for c in cameras if c in earlier)
        return Selection(plan, now_ns, tuple(newest[c] for c in cameras), before)

    def fit(
        self, selection: Selection, budget: Budget, publishes_ns: int | None = None
    ) -> tuple[list[View], FitReport] | None:
        """Decode, treat where the policy says so, and train; None if nothing of the selection could be
        decoded. The views returned are as they were delivered. publishes_ns: when the update is expected to
        be published, the present that stale views are treated for; None: when they were selected."""
        earlier = self.decoder.earlier(selection.earlier)
        views = self.decoder.views(selection.items)
        if not views:
            return None
        treated = self._treated(views, earlier, publishes_ns or selection.now_ns)
        if self.keyframes is None:
            return views, self.field.fit(treated, budget)
        given = self.keyframes.with_earlier(treated)
        if self.keyframes.outgrown(len(given)):
            self.field.reset()
        report = self.field.fit(given, budget)
        own = {view.camera for view in views}  # what is refused of an earlier viewpoint is no frame's matter
        return views, replace(report, refused=tuple(c for c in report.refused if c in own))

    def reset(self) -> None:
        """Forget the scene."""
        self.field.reset()
        if self.keyframes is not None:
            self.keyframes.forget()

    def _treated(self, views: list[View], earlier: Mapping[str, View], now_ns: int) -> list[View]:
        treatment = self.policy.treatment
        if treatment is None:
            return views
        begun = time.perf_counter()
        treated = treatment.treat(views, earlier, now_ns)
        self.treatment_cost.views += len(views)
        self.treatment_cost.seconds += time.perf_counter() - begun
        return treated

    def publication(
        self, selection: Selection, views: Sequence[View], fit: FitReport, published_ns: int
    ) -> Publication:
        """The record of an update that became visible at ``published_ns``; ages are taken then (6.35)."""
        ages = tuple((published_ns - view.generated_ns) / 1e6 for view in views)
        publication = Publication(
            number=self.number,
            t_s=(published_ns - self.start_ns) / 1e9,
            published_ns=published_ns,
            omega_ms=selection.plan.omega_ms,
            selected=tuple(view.camera for view in views),
            ages_ms=ages,
            aaoi_ms=float(np.mean(ages)),
            update_ms=(published_ns - selection.now_ns) / 1e6,
            steps=fit.steps,
            loss=fit.loss if np.isfinite(fit.loss) else None,
            refused=fit.refused,
        )
        self.number += 1
        return publication


def open_keyframes(config: KeyframesConfig | None, resumed: bool = False) -> Keyframes | None:
    """What keeps earlier viewpoints, where a scenario asks for it. resumed: as in ``Keyframes``."""
    if config is None:
        return None
    from edge_server.live.keyframes import Keyframes

    return Keyframes(config, resumed)


def open_foreground(config: ForegroundConfig | None, scenario: Scenario) -> Foreground | None:
    """What cuts the background out of views, where a scenario asks for it. Raises ScenarioError."""
    if config is None:
        return None
    from edge_server.foreground import ForegroundError
    from edge_server.foreground.foreground import make_foreground

    try:
        return make_foreground(config)
    except ForegroundError as error:
        raise ScenarioError(f"{scenario.path}: edge.foreground: {error}") from None


class Loop:
    """Runs ``updates`` on the wall clock until stopped.

    on_published(publication, renderer, views) is called after each update, on the loop's thread. Policy
    changes, pause and reset asked for from other threads take effect at the next decision.
    """

    def __init__(
        self,
        updates: Updates,
        clock: Clock,
        pacing: Pacing,
        grace_ms: float,
        on_published: Callable[[Publication, Renderer, list[View]], None],
        on_status: Callable[[str], None],
        on_checkpoint: Callable[[Path], None],
    ) -> None:
        self._updates = updates
        self._clock = clock
        self._pacing = pacing
        self._grace_ns = round(grace_ms * 1e6)
        self._on_published = on_published
        self._on_status = on_status
        self._on_checkpoint = on_checkpoint
        self._checkpoints: Queue[tuple[Path, Future[Path]]] = Queue()
        self._stop = threading.Event()
        self._lock = threading.Lock()
        self._next_policy: Policy | None = None
        self._reset = False
        self._update_ms = 0.0
        self._idle = False
        self.paused = False
        self.failure: BaseException | None = None
        self._thread = threading.Thread(target=self._main, name="loop", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Ask the loop to end after the update it is in, and wait for it."""
        self._stop.set()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    @property
    def alive(self) -> bool:
        return self._thread.is_alive()

    def use_policy(self, policy: Policy) -> None:
        with self._lock:
            self._next_policy = policy

    def request_reset(self) -> None:
        with self._lock:
            self._reset = True

    def request_checkpoint(self, path: Path) -> Future[Path]:
        """Have the field written to ``path`` between two updates; the future gives the path written."""
        future: Future[Path] = Future()
        self._checkpoints.put((path, future))
        return future

    def _main(self) -> None:
        try:
            self._on_status("compiling the field's kernels")
            self._updates.field.warm_up()
            self._await_cameras()
            while not self._stop.is_set():
                self._once()
        except BaseException as error:  # the server reports it and ends; nothing is hidden
            log.exception("the update loop failed")
            self.failure = error

    def _await_cameras(self) -> None:
        """Give every camera a chance to report, so that the first fit does not see half a rig."""
        seen, first_ns = 0, None
        wanted = len(self._updates.buffer.cameras)
        while not self._stop.is_set():
            here = len(self._updates.buffer.newest())
            now_ns = self._clock.now_ns()
            if here and first_ns is None:
                first_ns = now_ns
            if here == wanted or (first_ns is not None and now_ns - first_ns > self._grace_ns):
                return
            self._on_status(f"waiting for cameras: {here} of {wanted} have reported")
            seen = self._updates.buffer.wait(seen, _NAP_S)

    def _once(self) -> None:
        with self._lock:
            policy, self._next_policy = self._next_policy, None
            reset, self._reset = self._reset, False
        if policy is not None:
            self._updates.policy = policy
        if reset:
            self._updates.reset()
            log.info("the field was reset")
        self._write_checkpoints()
        if self.paused:
            self._on_status("paused")
            self._stop.wait(_NAP_S)
            return
        selection = self._select()
        if selection is None:
            return
        self._on_status(f"fitting {len(selection.items)} views")
        budget = self._pacing.budget()
        # An update takes about as long as the last one: its present lies that far ahead.
        publishes_ns = self._clock.now_ns() + round(self._update_ms * 1e6)
        fitted = self._updates.fit(selection, budget, publishes_ns)
        if fitted is None:
            self._stop.wait(0.01)  # every selected frame is damaged: newer ones will come
            return
        views, report = fitted
        self._warn_if_idle(report)
        renderer = self._updates.field.snapshot(present_ns=self._clock.now_ns())
        publication = self._updates.publication(selection, views, report, self._clock.now_ns())
        self._update_ms = publication.update_ms
        self._pacing.done(budget, publication.update_ms)
        self._on_published(publication, renderer, views)

    def _warn_if_idle(self, report: FitReport) -> None:
        """Say so once, and again if it comes back, where an update's time is too short to learn anything."""
        if report.steps == 0 and not self._idle:
            log.warning(
                "an update of %.0f ms made no step: all its time went into taking in new pictures. Give "
                "updates more (edge.update_ms or edge.deadline_ms), or take a field that needs less of it",
                report.seconds * 1e3,
            )
        self._idle = report.steps == 0

    def _write_checkpoints(self) -> None:
        while True:
            try:
                path, future = self._checkpoints.get_nowait()
            except Empty:
                return
            try:
                self._on_checkpoint(path)
                future.set_result(path)
            except OSError as error:  # a full disk must not end the updates; whoever asked is told
                log.error("checkpoint %s not written: %s", path, error)
                future.set_exception(error)

    def _select(self) -> Selection | None:
        """Plan, wait as the plan says, select; None if the controls changed meanwhile."""
        plan = self._updates.plan(self._clock.now_ns())
        seen = self._updates.buffer.arrivals
        while not self._stop.is_set():
            now_ns = self._clock.now_ns()
            selection = self._updates.select(plan, now_ns)
            if selection is not None:
                return selection
            asked = self._reset or self._next_policy is not None or not self._checkpoints.empty()
            if self.paused or asked:
                return None
            left_s = (plan.wait_until_ns - now_ns) / 1e9
            if left_s > 0:
                self._stop.wait(min(left_s, _NAP_S))
            else:
                self._on_status("waiting for a frame that qualifies")
                seen = self._updates.buffer.wait(seen, _NAP_S)
        return None
