"""One trial of a study: a deployment in virtual time under one policy, channel and seed.

A trial holds only plain values, including the seed. It can be hashed, sent to another process or machine,
and repeated bit for bit. Trials that differ only in policy share decision instants and deliveries (paired).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import Row
from edge_server.experiments.common.tables import mean_or_none
from edge_server.experiments.rollouts.episode import Stage, open_stage
from edge_server.experiments.studies import study_constants as tuned
from edge_server.experiments.studies.study import StudyError, StudyRequest, open_engine, print_once
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.images import to_bytes
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import SHOWN, Scorer
from edge_server.fields.registry import make_field
from edge_server.live.state import Publication
from edge_server.scheduler.learned.rewards import f_w
from edge_server.settings import read_config
from freshfield.scenario import Scenario, ScenarioError, load, parse, seed_sequence

# Scenes whose name differs from that of their scenario.
SCENARIOS = {"room": "room19"}
_MOMENT_S = 1e-6


@dataclass(frozen=True)
class Trial:
    """One trial.

    scene: a shipped scenario, a key of ``SCENARIOS``, or the file of a scenario.
    channel: the scenario's section.
    policy, value: name of the policy and its parameter.
    size: image width and height of a synthetic world.
    scale: divides the image sizes of a recording.
    cameras: number of cameras of a synthetic world; None: the scenario's own.
    steps: optimizer steps of the update, from an empty field, as in the thesis.
    every_ms: longest time for the update, until there would be the next decision.
    """

    scene: str
    seed: int
    channel: dict[str, Any]
    policy: str = "all"
    value: float | None = None
    size: int = 64
    scale: float = 1.0
    cameras: int | None = 19
    speed_m_per_s: float | None = 1.0
    field: str = "splat"
    field_options: dict[str, Any] = dataclasses.field(default_factory=dict)
    steps: int = 200
    every_ms: float = 900.0
    lpips: bool = True

    @property
    def stage(self) -> tuple[str, int, float, int | None, float | None]:
        """Settings that determine the images. Trials of one stage share rendered and decoded images."""
        return (self.scene, self.size, self.scale, self.cameras, self.speed_m_per_s)

    @property
    def first_ms(self) -> float:
        """Instant of the first decision."""
        return tuned.FIRST_DECISION_MS + tuned.STAGGER_MS * (self.seed % 64)

    def scenario(self) -> Scenario:
        """The deployment as a scenario. Raises ScenarioError."""
        shipped = scenario_of(self.scene, self.seed)
        source, edge = dict(shipped.source), dict(shipped.edge)
        cameras: Row = {"ids": list(shipped.cameras), "held_out": list(shipped.held_out)}
        if source.get("kind") == "world":
            source |= {"width": self.size, "height": self.size, "fps": tuned.TRIAL_FPS}
            if self.speed_m_per_s is not None and source.get("scene") != "tile":  # nothing moves there
                source["speed_m_per_s"] = self.speed_m_per_s
            if self.cameras is not None:
                cameras = {"count": self.cameras, "held_out": ["cam00"]}
        elif self.scale != 1.0:
            source["scale"] = self.scale * source.get("scale", 1.0)
        edge = {
            "field": self.field,
            "field_options": self.field_options,
            "policy": {"name": self.policy, "value": self.value},
            "updates": "cycle",  # as in the thesis
            "noisy_truth": edge.get("noisy_truth", False),
            "lpips": edge.get("lpips", "alex"),
        }
        data = {
            "name": shipped.name,
            "seed": self.seed,
            "cameras": cameras,
            "source": source,
            "channel": self.channel,
            "edge": edge,
        }
        return parse(data, shipped.path)

    def run_settings(self) -> RunSettings:
        return RunSettings(steps=self.steps, epoch_ms=self.every_ms, grace_ms=0.0, first_ms=self.first_ms, scratch=True)


def scenario_of(scene: str, seed: int = 0) -> Scenario:
    """The scenario of a scene. Raises ScenarioError."""
    return load(SCENARIOS.get(scene, scene), seed)


@lru_cache
def scene_label(scene: str) -> str:
    """What a scene is called in tables. Raises ScenarioError."""
    return scene if scene in SCENARIOS else scenario_of(scene).path.stem


@lru_cache
def recording(scene: str) -> str | None:
    """The data set that a scene plays, relative to the data folder; None for a synthetic world. Raises
    ScenarioError."""
    source = scenario_of(scene).source
    return None if source.get("kind") == "world" else str(source.get("data", ""))


@dataclass(frozen=True)
class Point:
    """A trial and its labels in the table."""

    labels: Row
    trial: Trial


def usual_trial(request: StudyRequest, scene: str, **more: Any) -> Trial:
    """The usual trial of a scene, with the image size and the steps of a quick or full pass. more: further arguments
    of ``Trial``."""
    sized: Row = {"size": 64, "steps": 150} if request.quick else {"size": 128, "steps": 400}
    if recording(scene) is not None:
        scale = 2.0 if request.quick else 1.0
        sized = {"scale": scale, "steps": sized["steps"], "speed_m_per_s": None}
    elif Path(scene).suffix:  # somebody's own scenario keeps its cameras and its speed
        sized |= {"cameras": None, "speed_m_per_s": None}
    return Trial(scene=scene, **{**sized, **more})


def scenes_here(request: StudyRequest, default: Sequence[str]) -> list[str]:
    """The requested scenes, else ``default``, without recorded ones whose data are neither beside them nor in the data
    folder. Raises StudyError if none is left."""
    wanted = list(request.scenes or default)
    found = []
    for scene in wanted:
        file = recording(scene)
        if file is None or request.folders.data_of(scenario_of(scene)) is not None:
            found.append(scene)
        else:
            where = "below the data folder (--data or FRESHFIELD_DATA), nor beside it"
            print_once(f"{scene} is left out: {file} is not {where}")
    if not found:
        raise StudyError(f"none of the scenes asked for is here: {', '.join(wanted)}")
    return found


def sweep(
    request: StudyRequest,
    scene: str,
    seeds: Iterable[int],
    conditions: Sequence[tuple[Row, Row]],
    x: str,
    values: Mapping[str, Sequence[float]],
    ideals: Sequence[tuple[Row, Row]] = (({}, {}),),
) -> list[Point]:
    """Points of every seed: in each condition use-all and each value of each policy; and without delay.

    conditions, ideals: (labels in the table, settings of the trial) of each.
    x: label that holds the value.
    values: policy -> its values.
    """
    found = []
    name = scene_label(scene)
    for seed in seeds:
        for labels, settings in conditions:
            base, labels = usual_trial(request, scene, seed=seed, **settings), {"scene": name, **labels}
            found.append(Point({**labels, "policy": "all"}, base))
            found += [
                Point({**labels, "policy": policy, x: value}, replace(base, policy=policy, value=value))
                for policy, some in values.items()
                for value in some
            ]
        for labels, settings in ideals:
            ideal = usual_trial(request, scene, seed=seed, channel={"preset": "ideal"}, **settings)
            found.append(Point({"scene": name, **labels, "policy": "no delay"}, ideal))
    return found


def run_points(points: Sequence[Point], request: StudyRequest) -> list[Row]:
    """The labels, the seed and the results of each point, also rated by F_w (6.37)."""
    with open_engine(request, "trials") as engine:
        results = engine.run(
            partial(run_trial, folders=request.folders),
            [point.trial for point in points],
            "trials",
            files=lambda trial: _files(trial, request.folders),
            group=lambda trial: (trial.stage, trial.field, repr(trial.field_options), trial.seed),
        )
    return [{**p.labels, "seed": p.trial.seed, **r, **f_w(r)} for p, r in zip(points, results)]


def _files(trial: Trial, folders: Folders) -> list[Path]:
    """What a trial's result depends on beside itself: its scenario's file, and what that names."""
    used, scenario = folders if trial.lpips else replace(folders, lpips=None), trial.scenario()
    return [scenario.path, *used.files_of(scenario)]


def run_trial(trial: Trial, folders: Folders) -> Row:
    """Run a trial. Returns what its decision came to.

    psnr_db, psnr_moving_db, ssim, lpips: at publication, the thesis's measure; None without a score.
    shown_psnr_db, ...: at random instants, of what a deployment shows (``_shown_scores``).
    views: number of used views.
    aaoi_ms: their mean age at publication (6.35).
    age_sum_ms: sum of the ages of all cameras (5.8).
    wait_ms: from decision to publication.
    Raises ScenarioError or DatasetError.
    """
    rng = np.random.default_rng(seed_sequence(trial.seed, "shown"))  # the same instants for every policy

    def look(publication: Publication, deployment: VirtualDeployment) -> Row:
        return _row(publication, deployment) | _shown_scores(publication, deployment, rng)

    return _decided(trial, folders, look)


def last_images(trial: Trial, folders: Folders) -> tuple[NDArray[np.uint8], NDArray[np.uint8], Row]:
    """(truth, rendering, figures) of the trial's decision on the held-out camera, uint8 (H, W, 3)."""

    def look(publication: Publication, deployment: VirtualDeployment) -> Any:
        present_ns, truth = publication.published_ns, deployment.truth
        assert truth is not None  # of ``open_stage``
        image, lens, pose = truth.view(trial.scenario().held_out[0], present_ns)
        color = deployment.updates.field.snapshot(present_ns).render(pose, lens).color
        return image, to_bytes(color), _row(publication, deployment)

    return _decided(trial, folders, look)


def _decided(trial: Trial, folders: Folders, look: Callable[[Publication, VirtualDeployment], Any]) -> Any:
    """What ``look`` sees at the publication of the trial's decision, however long its policy waits."""
    found: list[Any] = []

    def published(publication: Publication) -> None:
        if not found:
            found.append(look(publication, deployment))

    scenario, stage = trial.scenario(), _stage(trial.stage, trial.lpips, folders)
    deployment = build_deployment(
        scenario,
        trial.run_settings(),
        field=make_field(trial.field, trial.field_options, seed=0),
        cameras=stage.cameras,
        data=folders.data,
        on_published=published,
        truth=stage.truth,
    )
    # Stop just before the second decision, whose update may not be needed.
    deployment.run((trial.first_ms + trial.every_ms) / 1e3 - _MOMENT_S)
    for _ in range(tuned.TRIAL_PATIENCE):
        if found:
            return found[0]
        deployment.run(trial.every_ms / 1e3)
    raise ScenarioError(f"study {trial.scene}: no update was published; does a frame ever arrive?")


def _row(publication: Publication, deployment: VirtualDeployment) -> Row:
    ages = deployment.updates.buffer.ages_ms(publication.published_ns)
    return {
        "psnr_db": publication.psnr_db,
        "psnr_moving_db": publication.psnr_moving_db,
        "ssim": publication.ssim,
        "lpips": publication.lpips,
        "views": float(len(publication.selected)),
        "aaoi_ms": publication.aaoi_ms,
        "age_sum_ms": float(sum(a for a in ages.values() if a is not None)),
        "wait_ms": (publication.published_ns - deployment.decided_ns) / 1e6,
    }


def _shown_scores(publication: Publication, deployment: VirtualDeployment, rng: np.random.Generator) -> Row:
    """Scores (``fidelity.scorer.SHOWN``) of the publication, extrapolated to random instants until the next
    one.

    A deployment that decides again as soon as it has published shows an image for as long as the next one
    takes: its wait and its computing. So the image of a policy that waits for more views is shown for longer.
    At most one publication a capture period is assumed; otherwise a policy that does not wait would publish
    at every arrival, and be some ms fresher than this says.

    The instants are random if the truth is known at any instant; in a recording they are those of its frames.
    """
    truth, began_ns = deployment.truth, publication.published_ns
    assert truth is not None  # of ``open_stage``
    lasts_ns = max(began_ns - deployment.decided_ns, deployment.capture_period_ns)
    snapshot = deployment.updates.field.snapshot(began_ns)
    scores = []
    for k, random in enumerate(rng.random(tuned.SHOWN_INSTANTS)):
        at_ns = max(truth.nearest_ns(began_ns + round((k + random) / tuned.SHOWN_INSTANTS * lasts_ns)), began_ns)
        scores.append(truth.score(snapshot.at(at_ns), at_ns))
    return {f"shown_{name}": mean_or_none([getattr(s, name) for s in scores]) for name in SHOWN}


@lru_cache(4)  # a process keeps a few, because trials come grouped by their images
def _stage(stage: tuple[Any, ...], lpips: bool, folders: Folders) -> Stage:
    scene, size, scale, cameras, speed = stage
    trial = Trial(scene, 0, {"preset": "ideal"}, size=size, scale=scale, cameras=cameras, speed_m_per_s=speed)
    scenario = trial.scenario()
    metric = open_lpips(folders.lpips)[0] if lpips else None
    return open_stage(scenario, Scorer(metric, read_config(scenario).background), folders)
