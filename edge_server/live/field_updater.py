"""Decisions and updates of one field: decision epoch -> views -> fit -> publication.

Every method takes the time as an argument, so that the live loop and virtual time share them. The present is
the instant at which an update is published: fitting ages the scene as much as the network does.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from edge_server.fields import Budget, Field, FitReport, View
from edge_server.live import live_constants as tuned
from edge_server.live.buffer import FrameBuffer
from edge_server.live.camera_motion import CameraMotion
from edge_server.live.state import Publication
from edge_server.live.view_decoder import ViewDecoder
from edge_server.scheduler import STATE_PARTS, Epoch, Policy, SelectionWindow
from edge_server.settings import EdgeConfig, embedding_for
from freshfield.frame import Frame
from freshfield.plugins import short_name
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:  # imported at run time only where a policy is learned, or a scenario asks for it
    from edge_server.embed import Embedder
    from edge_server.embed.cache import EmbeddingCache
    from edge_server.foreground.foreground import Foreground
    from edge_server.live.keyframes import Keyframes
    from edge_server.scheduler.learned.state import State


log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Selection:
    """A finished decision.

    now_ns: instant of the selection.
    items: selected frames, without new ones beyond the update's limit.
    others: other frames that these cameras delivered since the last selection and that fit the limit, if the field
    wants every frame.
    arrivals: number of frames since the last selection, of all cameras; if the field wants every frame, of those
    that the update uses.
    """

    plan: SelectionWindow
    now_ns: int
    items: tuple[Frame, ...]
    others: tuple[Frame, ...] = ()
    arrivals: int = 0


class FieldUpdater:
    """Decides on and carries out the updates of one field from one buffer. Owns no thread, reads no clock.

    start_ns: when the run began; ``Publication.t_s`` counts from it.
    embedder: for policies that use image embeddings.
    keyframes: earlier viewpoints of moving cameras.
    foreground: cuts the background out of views.
    on_arrivals: select only after a frame has arrived since the last selection.
    number: number of the next update.
    forgiving: whether all views are used if the policy raises (live). policy_failures: number of times that this
    policy raised.
    materialize: gives buffered frames their images and poses if these are made late (virtual time).
    """

    def __init__(
        self,
        buffer: FrameBuffer,
        policy: Policy,
        field: Field,
        start_ns: int,
        embedder: Embedder | None = None,
        keyframes: Keyframes | None = None,
        foreground: Foreground | None = None,
        on_arrivals: bool = False,
    ) -> None:
        self.buffer = buffer
        self.forgiving, self._unplanned = False, False
        self.on_arrivals = on_arrivals
        self._selected_of = 0  # arrivals at the last selection
        self._selected: dict[str, Frame] = {}  # the newest selected frame of each camera
        self.decoder = ViewDecoder(foreground)
        self.embedder = embedder
        self.embeddings: EmbeddingCache | None = None
        if embedder is not None:
            from edge_server.embed.cache import EmbeddingCache

            # A frame that is both embedded and trained on is decoded once.
            self.embeddings = EmbeddingCache(embedder, self.decoder.view)
        self.materialize: Callable[[Sequence[Frame]], Sequence[Frame]] | None = None
        self.policy = policy
        self.field = field
        self.keyframes = keyframes
        self.start_ns = start_ns
        self.number = 0
        self._update_s = 0.0  # of the latest update
        self._motion: CameraMotion | None = None
        self._if_moving: Callable[[str], None] | None = None
        self._follow_field()

    def _follow_field(self) -> None:
        """Keep and decode what the field wants now."""
        self.buffer.keep_every_frame(self.field.frame_s is not None)
        most = self.field.most_pixels
        self.decoder.take_at_most(None if most is None else most // len(self.buffer.cameras))

    @property
    def policy(self) -> Policy:
        return self._policy

    @policy.setter
    def policy(self, policy: Policy) -> None:
        """Takes effect with the next decision. ValueError as ``check``."""
        self.check(policy)
        self._policy, self.policy_failures = policy, 0

    def check(self, policy: Policy) -> None:
        """Raises ValueError if ``policy`` needs embeddings that are not computed here: there is no embedder, or
        not the one that it was trained with."""
        dim, name = policy.embedding
        if dim == 0:
            return
        if self.embedder is None:
            raise ValueError(f"{policy.name} decides by image embeddings: it needs an edge.embedding section")
        if dim != self.embedder.dim or (name and name != self.embedder.name):
            raise ValueError(
                f"{policy.name} was trained with {name or 'embeddings'} of {dim} numbers, edge.embedding "
                f"is {self.embedder.name} of {self.embedder.dim}"
            )

    def _epoch(self, newest: Mapping[str, Frame], now_ns: int) -> Epoch:
        """What the policy may look at, at ``now_ns``."""

        def state(parts: Sequence[str] = STATE_PARTS) -> State:
            from edge_server.scheduler.learned.observation import observe

            seen = newest
            if self.materialize is not None:
                seen = {item.camera: item for item in self.materialize(tuple(newest.values()))}
            return observe(self.buffer.cameras, seen, now_ns, self.embeddings, parts, keep_frames=True)

        generated = {c: item.generated_edge_ns for c, item in newest.items()}
        received = {c: item.received_ns for c, item in newest.items()}
        return Epoch(now_ns, self.number, generated, state, received)

    def plan(self, now_ns: int) -> SelectionWindow:
        """The first half of a decision: how long to wait for frames."""
        try:
            return self.policy.plan(self._epoch(self.buffer.newest(), now_ns))
        except Exception as error:
            self._policy_failed(error)
            self._unplanned = True
            return SelectionWindow()

    def _policy_failed(self, error: Exception) -> None:
        """Go on without the policy's decision, or raise."""
        if not self.forgiving:
            raise error
        if not self.policy_failures:
            name = short_name(self.policy.name)
            log.warning(
                "policy %s failed, all views are used: %s: %s", name, type(error).__name__, error, exc_info=error
            )
        self.policy_failures += 1

    @property
    def troubles(self) -> tuple[str, ...]:
        """Problems of the field and of the policy, in words."""
        found = tuple(getattr(self.field, "troubles", ()))
        if self.policy_failures:
            found += (
                f"policy {short_name(self.policy.name)} failed {self.policy_failures} times: all views were used",
            )
        return found

    def select(
        self, plan: SelectionWindow, now_ns: int, budget: Budget | None = None, most_new: int | None = None
    ) -> Selection | None:
        """The second half of a decision: the frames in the buffer at ``now_ns`` that the policy uses; None: keep
        waiting.

        For a field that wants every frame, the number of new frames is limited:
        budget: what the fit that follows may spend; one in seconds sets the limit.
        most_new: the limit otherwise (virtual time, where no clock determines it).
        """
        total, newest = self.buffer.observe()
        arrivals = total - self._selected_of
        nothing_new = not arrivals and not self.buffer.held_back
        if now_ns < plan.wait_until_ns or (self.on_arrivals and nothing_new):
            return None
        self._follow_field()
        unplanned, self._unplanned = self._unplanned, False
        try:
            cameras = newest if unplanned else self.policy.select(self._epoch(newest, now_ns), plan)
            chosen = [newest[c] for c in cameras]
        except Exception as error:
            self._policy_failed(error)
            chosen = list(newest.values())
        if not chosen:
            return None
        self._selected_of = total
        moving = getattr(self.field, "moving_shares", None)
        items, others = self.buffer.take(chosen, self._most_new(budget, most_new), moving)
        if self.field.frame_s is not None:
            own = {item.camera: item for item in items}
            arrivals = len(others) + sum(self._selected.get(c) is not item for c, item in own.items())
            self._selected |= own
        return Selection(plan, now_ns, items, others, arrivals)

    def _most_new(self, budget: Budget | None, most_new: int | None) -> int | None:
        """Number of new frames for which a field that wants every frame has time; None: all."""
        frame_s = self.field.frame_s
        if not frame_s or budget is None or budget.seconds is None:
            return None if frame_s is None else most_new
        # On a slow machine an update may exceed its budget; frames then get their share of its real duration.
        seconds = max(budget.seconds, self._update_s)
        return max(int(tuned.INTAKE_SHARE * seconds / frame_s), tuned.LEAST_TAKEN)

    def fit(self, selection: Selection, budget: Budget) -> tuple[list[View], FitReport] | None:
        """Decode the selected views and train on them.

        Returns the views as delivered, and the field's report; None if no view can be decoded.
        """
        views = self.decoder.views(selection.items)
        if not views:
            return None
        others = self.decoder.others(selection.others)
        if self._motion is not None and (camera := self._motion.moving([*others, *views])) is not None:
            self._motion, if_moving = None, self._if_moving
            assert if_moving is not None
            if_moving(camera)
        if self.keyframes is None:
            return views, self.field.fit([*others, *views], budget)
        supervision = self.keyframes.with_earlier(views)
        if self.keyframes.should_restart(len(supervision)):
            self.field.reset()
        report = self.field.fit([*others, *supervision], budget)
        # Refusals of earlier viewpoints are not counted against current frames.
        current = {view.camera for view in views}
        return views, replace(report, refused=tuple(c for c in report.refused if c in current))

    def watch_cameras(
        self, config: EdgeConfig, make: Callable[[EdgeConfig], Field], changed: Callable[[EdgeConfig, str], None]
    ) -> None:
        """Restart with field, keyframes and updates of ``config`` once a camera is found to move.

        make: makes the field. changed(config, camera): called then, on the thread of ``fit``.
        """

        def if_moving(camera: str) -> None:
            self.field.reset()  # releases what it shares with the next one
            self.field = make(config)
            self.field.warm_up()
            self.keyframes = _keyframes(config)
            self.on_arrivals = config.updates == "arrivals"
            changed(config, camera)

        self._motion, self._if_moving = CameraMotion(), if_moving

    def reset(self) -> None:
        """Forget the scene, and the frames of it that wait."""
        self.buffer.keep_every_frame(False)  # until the next selection
        self.field.reset()
        if self.keyframes is not None:
            self.keyframes.clear()

    def publication(
        self, selection: Selection, views: Sequence[View], fit: FitReport, published_ns: int
    ) -> Publication:
        """The record of an update that became visible at ``published_ns``; ages are taken then (6.35)."""
        ages = tuple((published_ns - view.generated_ns) / 1e6 for view in views)
        used = {view.camera for view in views}
        network = [i.received_ns - i.generated_edge_ns for i in selection.items if i.camera in used]
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
            network_ms=float(np.mean(network)) / 1e6 if network else None,
        )
        self.number += 1
        self._update_s = publication.update_ms / 1e3
        return publication


def open_updater(
    scenario: Scenario,
    config: EdgeConfig,
    policy: Policy,
    field: Field,
    start_ns: int,
    resumed: bool = False,
    embedder: Embedder | None = None,
) -> FieldUpdater:
    """The updater of a scenario's training cameras, configured by its edge section.

    resumed: the field has been trained before (see ``Keyframes``).
    embedder: one that several runs share; None opens the scenario's.
    Nothing of embedder, keyframes, foreground and depth network is imported unless asked for. Raises ScenarioError.
    """
    keyframes = _keyframes(config, resumed)
    foreground: Foreground | None = None
    if config.foreground is not None:
        from edge_server.foreground.foreground import make_foreground

        try:
            foreground = make_foreground(config.foreground)
        except ValueError as error:
            raise ScenarioError(f"{scenario.path}: edge.foreground: {error}") from None
    try:
        if config.depth_network is not None:
            _use_depth_network(field, scenario.path.parent / config.depth_network)
        embedding = embedding_for(config, policy)
        if embedder is None and embedding is not None:
            from edge_server.embed import make_embedder

            embedder = make_embedder(embedding)
        buffer = FrameBuffer(scenario.training)
        on_arrivals = config.updates == "arrivals"
        return FieldUpdater(buffer, policy, field, start_ns, embedder, keyframes, foreground, on_arrivals)
    except ValueError as error:
        raise ScenarioError(f"{scenario.path}: edge: {error}") from None


def _use_depth_network(field: Field, file: Path) -> None:
    """Open the network if the field can use one: ``splat`` in layers. Raises ValueError if the file holds none."""
    from edge_server.embed import open_depth_network

    use = getattr(field, "use_depth_network", None)
    if use is None:  # in a resumed run, cameras may have begun to move
        log.warning("edge.depth_network is ignored: only splat in layers, with fixed cameras, can use one")
        return
    try:
        use(open_depth_network(file))
    except ValueError as error:
        raise ValueError(f"depth_network: {error}") from None


def _keyframes(config: EdgeConfig, resumed: bool = False) -> Keyframes | None:
    if config.keyframes is None:
        return None
    from edge_server.live.keyframes import Keyframes

    return Keyframes(config.keyframes, resumed)
