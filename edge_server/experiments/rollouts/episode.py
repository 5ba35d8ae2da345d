"""Episodes: run a virtual deployment, draw decisions from it, and evaluate choices with field fits.

The channel does not depend on the edge's decisions, so one recorded run serves every action at every
decision, and the record gives the buffer at any instant. Each choice gets its own field fit, from an empty field or
from a copy of the same warm field, so actions of one decision are comparable (thesis 5.4, algorithm 1; 6.3,
algorithm 2).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from camera_node.capture import Camera
from camera_node.settings import WorldConfig, source_config
from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.tables import mean_or_none
from edge_server.experiments.rollouts.setting import Setting
from edge_server.experiments.virtual.from_scenario import build_deployment, build_truth, exact_scene, training_cameras
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.truth import ExactTruth, Truth
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, Field, View
from edge_server.fields.registry import make_field
from edge_server.live.buffer import FrameBuffer
from edge_server.live.view_decoder import ViewDecoder
from edge_server.scheduler.learned.observation import observe
from edge_server.scheduler.learned.state import State
from edge_server.settings import read_config
from freshfield.frame import Frame
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from edge_server.embed import Embedder
    from edge_server.embed.cache import EmbeddingCache

Image = Callable[[str, float], NDArray[np.uint8]]
SCORES = ("psnr_db", "psnr_moving_db", "ssim", "lpips")
# Instant of the first decision of the deployment's own edge: never within an episode.
_NEVER_MS = 1e11


@dataclass(frozen=True)
class Choice:
    """A policy's choice: the newest frames of ``cameras`` at ``at_ns``."""

    cameras: tuple[str, ...]
    at_ns: int


@dataclass(frozen=True)
class Outcome:
    """Result of an update: fidelity seen from a held-out camera (None without a score), aaoi_ms (6.35) of the used
    views at publication (None without views), number of views used, wait_ms from decision to publication."""

    psnr_db: float | None
    psnr_moving_db: float | None
    ssim: float | None
    lpips: float | None
    aaoi_ms: float | None
    views: float
    wait_ms: float


def mean_outcome(outcomes: Sequence[Outcome]) -> Outcome:
    """The outcome of one choice, its scores averaged over the cameras that have them."""
    means: dict[str, Any] = {name: mean_or_none([getattr(o, name) for o in outcomes]) for name in SCORES}
    return replace(outcomes[0], **means)


@dataclass(frozen=True)
class DecisionPoint:
    """A decision as plain values: the policy's inputs and the frames that arrive while it waits.

    state: at ``now_ns`` (6.33). arrivals: in order of reception; up to ``now_ns`` only each camera's
    youngest. until_ns: end of the channel's record.
    """

    seed: int
    number: int
    now_ns: int
    until_ns: int
    cameras: tuple[str, ...]
    arrivals: tuple[Frame, ...]
    state: State

    def newest(self, at_ns: int) -> dict[str, Frame]:
        """Omega(t) of (5.6): the newest arrival of each camera at ``at_ns``, in the cameras' order."""
        return _newest(self.arrivals, at_ns, self.cameras)

    def next_arrival_ns(self, after_ns: int) -> int | None:
        """Instant of the first arrival after ``after_ns``; None if the record has none."""
        return next((a.received_ns for a in self.arrivals if a.received_ns > after_ns), None)


def _newest(arrivals: Iterable[Frame], at_ns: int, cameras: Sequence[str]) -> dict[str, Frame]:
    """Youngest arrival of each camera received by ``at_ns``, in the cameras' order; cameras without one are
    left out. arrivals: in order of reception."""
    found: dict[str, Frame] = {}
    for arrival in arrivals:
        if arrival.received_ns > at_ns:
            break
        known = found.get(arrival.camera)
        if known is None or arrival.generated_edge_ns > known.generated_edge_ns:
            found[arrival.camera] = arrival
    return {c: found[c] for c in cameras if c in found}


class _Recorder(FrameBuffer):
    """A buffer that records every frame put into it."""

    def __init__(self, cameras: Sequence[str]) -> None:
        super().__init__(cameras)
        self.record: list[Frame] = []

    def put(self, frame: Frame, received_ns: int) -> None:
        super().put(frame, received_ns)
        self.record.append(replace(frame, received_ns=received_ns))


def _remembered(image: Image, period_ns: int | None) -> Image:
    """``image`` with a cache; with ``period_ns``, instants one period apart share a rendering."""
    known = lru_cache(tuned.TRUTHS_KEPT)(lambda camera, at_ns: image(camera, at_ns / 1e9))
    return lambda camera, t_s: known(camera, round(t_s * 1e9) % period_ns if period_ns else round(t_s * 1e9))


@dataclass(frozen=True)
class Stage:
    """Of one motion: the truth of the held-out cameras, and the training cameras."""

    truth: Truth
    cameras: list[Camera]


def open_stage(scenario: Scenario, scorer: Scorer, folders: Folders, period_ns: int | None = None) -> Stage:
    """The stage of a scenario, with a cache of its true images. period_ns: after which the motion repeats. Raises
    ScenarioError or DatasetError."""
    truth = build_truth(scenario, source_config(scenario), read_config(scenario), scorer, folders.data)
    if truth is None:
        raise ScenarioError(f"{scenario.path}: cameras.held_out: no camera is held out, so that nothing is scored")
    if isinstance(truth, ExactTruth):
        truth = replace(truth, image=_remembered(truth.image, period_ns))
    return Stage(truth, training_cameras(scenario, folders.data))


class EpisodeFactory:
    """Objects that the episodes of a setting share in one process: scorer, field, embedder, and the images if
    all episodes have the same motion."""

    def __init__(self, setting: Setting, folders: Folders) -> None:
        scenario = setting.scenario
        self._edge = edge = read_config(scenario)
        source = source_config(scenario)
        self._moving, self._period_ns = False, None
        if isinstance(source, WorldConfig):
            scene = exact_scene(scenario, source)
            self._moving = scene.moving and setting.motions and hasattr(scene.params, "motion_seed")
            if scene.moving and not self._moving:
                self._period_ns = round(scene.period_s * 1e9)
        lpips = None if edge.lpips == "none" else open_lpips(folders.lpips)[0]
        self._scorer = Scorer(lpips, edge.background)
        self.setting, self.folders = setting, folders
        # Of each the last is kept, with its images.
        self._stage_of, self._field_of = lru_cache(1)(self._open_stage), lru_cache(1)(self._make_field)
        self.episode = lru_cache(1)(partial(Episode, self))
        if not self._moving:
            self.stage(0)  # what is wrong with it is said now
        self.embedder: Embedder | None = None
        if "semantics" in setting.parts:
            # Loaded only where the state includes semantics.
            from edge_server.embed import make_embedder
            from edge_server.embed.settings import EmbeddingConfig

            self.embedder = make_embedder(edge.embedding or EmbeddingConfig())

    def scenario(self, seed: int) -> Scenario:
        """The deployment of an episode."""
        return self.setting.seeded(seed, self._moving)

    def stage(self, seed: int) -> Stage:
        """Truth and training cameras of an episode."""
        return self._stage_of(seed if self._moving else None)

    def _open_stage(self, seed: int | None) -> Stage:
        scenario = self.setting.scenario if seed is None else self.scenario(seed)
        return open_stage(scenario, self._scorer, self.folders, self._period_ns)

    def embeddings(self) -> EmbeddingCache | None:
        """A new cache for one episode: frame numbers repeat across episodes with different images."""
        if self.embedder is None:
            return None
        from edge_server.embed.cache import EmbeddingCache

        return EmbeddingCache(self.embedder, ViewDecoder().view)

    def field(self, seed: int) -> Field:
        """The field of an episode, in any state: the caller must reset or load it."""
        return self._field_of(self.setting.field_seed(seed))

    def _make_field(self, seed: int) -> Field:
        try:
            return make_field(self._edge.field, {**self._edge.field_options, "threads": 1}, seed=seed)
        except ValueError as error:
            raise ScenarioError(f"{self.setting.scenario.path}: edge: {error}") from None


class Episode:
    """The deployment of one seed: its decisions and the field fits of choices."""

    def __init__(self, factory: EpisodeFactory, seed: int) -> None:
        self._factory, setting = factory, factory.setting
        self.seed = seed
        rng = factory.scenario(seed).rng("decisions")
        lead, span = setting.lead_ms / tuned.INSTANT_GRID_MS, setting.span_ms / tuned.INSTANT_GRID_MS
        at = np.sort(rng.integers(round(lead), round(lead + span), setting.decisions))
        self.instants_ns = [int(tick) * tuned.INSTANT_GRID_MS * 10**6 for tick in at]
        self._until_ns = self.instants_ns[-1] + round(setting.horizon_ms * 1e6)
        self._deployment, self._record = self._recorded()
        self._views: dict[tuple[str, int], View | None] = {}
        self._warm: list[dict[str, NDArray[Any]]] = []
        self._embeddings = factory.embeddings()
        self.points = tuple(self._point(number) for number in range(setting.decisions))
        self._scored: dict[tuple[int, Choice, tuple[str, ...]], dict[str, Outcome]] = {}

    def _recorded(self) -> tuple[VirtualDeployment, list[Frame]]:
        """Run the deployment to the end of the record; returns it and all arrivals."""
        factory, setting = self._factory, self._factory.setting
        scenario, stage = factory.scenario(self.seed), factory.stage(self.seed)
        edge = {**setting.scenario.edge, "policy": {"name": "all"}}
        deployment: VirtualDeployment = build_deployment(
            replace(scenario, edge=edge),
            RunSettings(steps=1, epoch_ms=1.0, first_ms=_NEVER_MS, score_every_ms=None),
            field=factory.field(self.seed),
            cameras=stage.cameras,
            data=factory.folders.data,
            truth=stage.truth,
        )
        recorder = _Recorder(scenario.training)
        deployment.updates.buffer = recorder
        deployment.run(self._until_ns / 1e9)
        return deployment, recorder.record

    def evaluate(self, number: int, choice: Choice, cameras: tuple[str, ...] | None = None) -> dict[str, Outcome]:
        """Fit the choice at a decision and score it at publication: an outcome from each of ``cameras`` (None:
        those that reward). An empty choice, or one without a decodable frame, has no scores. Equal choices are
        fitted once."""
        asked = number, choice, cameras or self._factory.setting.rewarding
        if asked not in self._scored:
            self._scored[asked] = self._carried_out(*asked)
        return self._scored[asked]

    def _carried_out(self, number: int, choice: Choice, cameras: tuple[str, ...]) -> dict[str, Outcome]:
        setting, point = self._factory.setting, self.points[number]
        newest = point.newest(choice.at_ns)
        chosen = [newest[c] for c in choice.cameras]
        views = self._decoded(chosen)
        if not views:
            waited_ms = (choice.at_ns - point.now_ns) / 1e6
            nothing = Outcome(**dict.fromkeys(SCORES), aaoi_ms=None, views=0.0, wait_ms=waited_ms)
            return dict.fromkeys(cameras, nothing)
        published_ns = choice.at_ns + setting.compute.charge_ns(setting.steps)
        field = self._factory.field(self.seed)
        warm = None if setting.scratch else self._warm_state(number)
        if warm is None:
            field.reset()
        else:
            field.load_state(warm)
        field.fit(views, Budget(steps=setting.steps))
        snapshot, truth = field.snapshot(published_ns), self._factory.stage(self.seed).truth
        aaoi_ms = float(np.mean([(published_ns - view.generated_ns) / 1e6 for view in views]))
        wait_ms = (published_ns - point.now_ns) / 1e6
        found = {}
        for camera in cameras:
            score = truth.of((camera,)).score(snapshot, published_ns)
            scores = {name: getattr(score, name) for name in SCORES}
            found[camera] = Outcome(**scores, aaoi_ms=aaoi_ms, views=float(len(views)), wait_ms=wait_ms)
        return found

    def _point(self, number: int) -> DecisionPoint:
        setting, now_ns = self._factory.setting, self.instants_ns[number]
        cameras, record = setting.scenario.training, self._record
        reported = _newest(record, now_ns, cameras)
        arrivals = sorted(reported.values(), key=lambda a: a.received_ns)
        arrivals += [a for a in record if a.received_ns > now_ns]
        state = self.state(reported, now_ns)
        return DecisionPoint(self.seed, number, now_ns, self._until_ns, cameras, tuple(arrivals), state)

    def state(self, newest: Mapping[str, Frame], at_ns: int) -> State:
        """The state of the buffer (6.33) that holds the frames of ``newest``, by camera, at an instant."""
        setting = self._factory.setting
        items = self._deployment.with_images(sorted(newest.values(), key=lambda a: a.received_ns))
        by_camera = {item.camera: item for item in items}
        return observe(setting.scenario.training, by_camera, at_ns, self._embeddings, setting.parts)

    def _decoded(self, arrivals: Sequence[Frame]) -> list[View]:
        """Views in the given order, each decoded once; undecodable frames are left out."""
        missing = [a for a in arrivals if (a.camera, a.sequence) not in self._views]
        for item in self._deployment.with_images(missing):
            views = ViewDecoder().views([item])
            self._views[item.camera, item.sequence] = views[0] if views else None
        found = [self._views.get((a.camera, a.sequence)) for a in arrivals]
        return [view for view in found if view is not None]

    def _warm_state(self, number: int) -> dict[str, NDArray[Any]]:
        """Field state before a decision, independent of all choices."""
        setting, field = self._factory.setting, self._factory.field(self.seed)
        while len(self._warm) <= number:
            point = self.points[len(self._warm)]
            # The record has every delivery by then; a decision keeps only each camera's youngest.
            then_ns = point.now_ns - round(setting.refresh_ms * 1e6)
            if self._warm:
                field.load_state(self._warm[-1])
            else:
                field.reset()
            steps = setting.steps if self._warm else setting.warm_steps
            views = self._decoded(list(_newest(self._record, then_ns, point.cameras).values()))
            if views:
                field.fit(views, Budget(steps=steps))
            self._warm.append(field.state())
        return self._warm[number]
