"""Measures how long an update should take: the shown fidelity of a moving scene in virtual time, by update
time.

The field is warm: it has converged on the first instant and is not reset. A longer update fits its views
better, but they are older when it is published. A field in layers follows arrivals instead: its update time
is the time from one update to the next, and it starts empty, because it learns the static part from frames
alone.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.capture import Camera
from edge_server.experiments.common.tables import mean_or_none, over_seeds
from edge_server.experiments.frontier.from_scratch import lpips_of
from edge_server.experiments.virtual.costs import UpdateCosts
from edge_server.experiments.virtual.from_scenario import build_deployment, training_cameras
from edge_server.experiments.virtual.run_settings import Compute, RunSettings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.scorer import SHOWN, PerceptualMetric, Scorer
from edge_server.fields import Budget, Field, View
from edge_server.fields.registry import make_field, option_help
from edge_server.live.state import Publication
from freshfield import payload
from freshfield.scenario import Scenario, parse
from freshfield.settings import as_mapping

# Number of instants of a run at which the shown image is scored, and of publications that are scored: their
# mean is as good as that of hundreds.
_INSTANTS, _SCORED = 40, 16
# Share of a run at its start that is not counted: its publications depend more on the start than on the
# update time.
_SETTLED_SHARE = 0.25
# To measure the cost of updates: steps of short and long ones, number of each, time between their images.
_FEW, _MANY, _UPDATES, _BETWEEN_NS = 4, 20, 5, 250_000_000
# Of a field in layers: seconds until it is warm, update time meanwhile, and steps per second of its static
# field, which run on another core.
_LEAD_S, _LEAD_UPDATE_S, _STATIC_STEPS_PER_S = 8.0, 0.02, 250.0
MEDIUM, LAYERS = "medium", "layers"
METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips")
SHOWN_METRICS = tuple(f"shown_{name}" for name in SHOWN)


@dataclass(frozen=True)
class MovingScene:
    """A moving scene and its network."""

    scene: str = "room"
    cameras: int = 13
    size: int = 96
    fps: float = 15.0
    channel: str = "ch5"
    policy: str = "all"
    policy_value: float | None = None

    def scenario(self, speed_m_per_s: float, field: str, options: Mapping[str, Any], seed: int) -> Scenario:
        """The deployment as a scenario."""
        return parse(
            {
                "name": f"{self.scene} at {speed_m_per_s:g} m/s",
                "seed": seed,
                "cameras": {"count": self.cameras, "held_out": ["cam00"], "phase": "spread"},
                "source": {
                    "kind": "world",
                    "scene": self.scene,
                    "width": self.size,
                    "height": self.size,
                    "fps": self.fps,
                    "speed_m_per_s": speed_m_per_s,
                },
                "channel": {"preset": self.channel},
                "edge": {
                    "field": field,
                    "field_options": dict(options),
                    "policy": {"name": self.policy, "value": self.policy_value},
                    "updates": "arrivals" if options.get("layers") else "cycle",
                },
            },
            Path("frontier"),
        )


@dataclass(frozen=True)
class Setting:
    """A field as it is updated: with its own options (MEDIUM), or in layers (LAYERS)."""

    field: str
    name: str
    options: Mapping[str, Any]

    @property
    def label(self) -> str:
        """As tables name it."""
        return f"{self.field} {self.name}"


def live_settings(fields: Sequence[str], options: Mapping[str, Any]) -> list[Setting]:
    """Each field with ``options``, after the same in layers if it has any."""
    return [
        Setting(name, kind, {**more, **options})
        for name in fields
        for kind, more in ((LAYERS, {"layers": True}), (MEDIUM, {}))
        if kind == MEDIUM or "layers" in option_help(name)
    ]


@dataclass(frozen=True)
class Charged:
    """What is measured to be charged: updates of a warm field at one speed."""

    moving: MovingScene
    speed: float
    setting: Setting
    warm_steps: int


@dataclass(frozen=True)
class MovingRun:
    """Updates of about ``update_s`` for ``seconds`` of virtual time. compute: what they are charged."""

    moving: MovingScene
    speed: float
    setting: Setting
    seed: int
    warm_steps: int
    update_s: float
    seconds: float
    compute: Compute

    def facts(self) -> dict[str, Any]:
        """What a row says of its run."""
        return {
            "field": self.setting.field,
            "effort": self.setting.name,
            "options": dict(self.setting.options),
            "speed_m_per_s": self.speed,
            "planned_update_s": self.update_s,
            "seed": self.seed,
        }


def run_updates(run: MovingRun, weights: Path | None = None) -> dict[str, Any]:
    """Mean scores of a run. weights: folder of LPIPS weights."""
    of = run.speed, run.setting.field, json.dumps(run.setting.options, sort_keys=True), run.seed, run.warm_steps
    layers = run.setting.name == LAYERS
    steps = static_steps(run.update_s) if layers else steps_for(run.update_s, run.compute)
    start = _warm_start(run.moving, *of)
    return start.run(steps, run.compute, run.seconds, lpips_of(weights), run.update_s if layers else 0.0)


@lru_cache(maxsize=1)  # runs of one warm field follow each other
def _warm_start(moving: MovingScene, speed: float, field: str, options: str, seed: int, warm_steps: int) -> WarmStart:
    return WarmStart(moving, speed, field, json.loads(options), seed, warm_steps)


class WarmStart:
    """Cameras of a scene at one speed, which keep their renderings, and a warm field: converged on the first
    instant, or in layers that follow arrivals for a while before each run."""

    def __init__(
        self, moving: MovingScene, speed: float, field: str, options: Mapping[str, Any], seed: int, warm_steps: int
    ) -> None:
        self.scenario = moving.scenario(speed, field, options, seed)
        self.cameras = training_cameras(self.scenario)
        self.field: Field = make_field(field, options, seed=seed)
        self.layers = bool(options.get("layers"))
        if not self.layers:
            self.field.fit([_view(camera) for camera in self.cameras], Budget(steps=warm_steps))
        self._warm = self.field.state()

    def run(
        self, steps: int, compute: Compute, seconds: float, lpips: PerceptualMetric | None = None, every_s: float = 0.0
    ) -> dict[str, Any]:
        """Run updates of ``steps`` for ``seconds`` of virtual time, starting with the warm field. Returns
        mean scores.

        every_s: least time from one update to the next.
        """
        settings = RunSettings(
            steps,
            compute=compute,
            epoch_ms=1e3 * every_s,
            score_every_ms=1e3 * seconds / _SCORED,
            shown_every_ms=1e3 * seconds / _INSTANTS,
        )
        if self.layers:
            self.field.reset()
            deployment = self.lead(settings, Scorer(lpips))
            deployment.settings = settings
        else:
            self.field.load_state(self._warm)
            deployment = build_deployment(
                self.scenario, settings, field=self.field, scorer=Scorer(lpips), cameras=self.cameras
            )
        from_ns = deployment.clock.now_ns() + round(_SETTLED_SHARE * seconds * 1e9)
        publications = deployment.run(seconds)
        scored = [p for p in publications if p.psnr_db is not None and p.published_ns >= from_ns]
        shown = [
            (score, age_ms)
            for score, age_ms in zip(deployment.shown, deployment.shown_age_ms)
            if score.published_ns >= from_ns
        ]
        return {
            "steps": steps,
            "update_s": max(every_s, compute.charge_ns(steps) / 1e9),
            "updates": len(publications),
            "scored": len(scored),
            "aaoi_ms": mean_or_none([p.aaoi_ms for p in publications]),
            **{name: mean_or_none([getattr(p, name) for p in scored]) for name in METRICS},
            "shown_age_ms": mean_or_none([age_ms for _, age_ms in shown]),
            **{f"shown_{name}": mean_or_none([getattr(s, name) for s, _ in shown]) for name in SHOWN},
            "frames": deployment.frames(),
        }

    def lead(
        self, settings: RunSettings, scorer: Scorer | None = None, costs: UpdateCosts | None = None
    ) -> VirtualDeployment:
        """A deployment with warm layers.

        settings: how shown images are scored.
        costs: records the last third of the updates.
        """
        settings = replace(
            settings,
            steps=static_steps(_LEAD_UPDATE_S),
            compute=Compute(),
            epoch_ms=1e3 * _LEAD_UPDATE_S,
            score_every_ms=None,
        )

        def published(publication: Publication) -> None:
            if costs is not None:
                costs.published(deployment.updates, publication.t_s >= _LEAD_S * 2 / 3)

        deployment = build_deployment(
            self.scenario, settings, field=self.field, scorer=scorer, cameras=self.cameras, on_published=published
        )
        deployment.run(_LEAD_S)
        return deployment


def measure_compute(asked: Charged) -> dict[str, float]:
    """Measure the time of updates of a warm field on this machine while the scene moves and every image is new;
    returns a ``Compute`` as a mapping.

    ms_per_step is for a step, ms_per_update for everything else (reading the images, following motion, a snapshot),
    from medians of ``_UPDATES`` short and as many long updates. For layers ms_per_update and ms_per_view, in processor
    time and without the static field.

    Other processes lengthen the wall time, additional threads the processor time, so the shorter one is used.
    """
    setting = asked.setting
    start = WarmStart(asked.moving, asked.speed, setting.field, setting.options, 0, asked.warm_steps)
    start.field.warm_up()
    if start.layers:
        costs = UpdateCosts()
        costs.watch(start.field)
        lead = start.lead(RunSettings(steps=1), costs=costs)
        cost = costs.measured(lead.with_images(tuple(lead.updates.buffer.newest().values())))
        return as_mapping(Compute(ms_per_update=round(cost["update_ms"], 3), ms_per_view=round(cost["view_ms"], 3)))
    taken: dict[int, list[float]] = {_FEW: [], _MANY: []}
    for number in range(1, 2 * _UPDATES + 3):
        views = [_view(camera, number * _BETWEEN_NS) for camera in start.cameras]
        steps = (_FEW, _MANY)[number % 2]
        began = time.perf_counter(), time.process_time()
        start.field.fit(views, Budget(steps=steps))
        start.field.snapshot()
        spent = time.perf_counter() - began[0], time.process_time() - began[1]
        if number > 2:  # no motion is known in the first of each
            taken[steps].append(1e3 * min(spent))
    few, many = (statistics.median(taken[steps]) for steps in (_FEW, _MANY))
    ms_per_step = max((many - few) / (_MANY - _FEW), 0.01)
    return as_mapping(Compute(round(ms_per_step, 3), round(max(few - _FEW * ms_per_step, 0.0), 3)))


def static_steps(update_s: float) -> int:
    """Steps of the static field of layers during one update."""
    return max(1, round(_STATIC_STEPS_PER_S * update_s))


def steps_for(update_s: float, compute: Compute) -> int:
    """Number of optimizer steps for which an update of about ``update_s`` has time, at least one."""
    return max(1, round((update_s * 1e3 - compute.ms_per_update) / compute.ms_per_step))


def best(rows: list[dict[str, Any]], metric: str = "shown_psnr_moving_db") -> dict[str, Any] | None:
    """The row with the highest ``metric``; None if no row has it."""
    known = [row for row in rows if row[metric] is not None]
    return max(known, key=lambda row: row[metric]) if known else None


def mean_over_seeds(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over seeds of the rows with the same field, effort, speed and planned update time, with the
    standard errors of the two shown PSNRs (None for a single seed)."""
    keys = ("field", "effort", "speed_m_per_s", "planned_update_s")
    names = ("update_s", "steps", "updates", "scored", "aaoi_ms", *METRICS, "shown_age_ms", *SHOWN_METRICS)
    means = over_seeds(rows, keys, names, mean_or_none)
    errors = over_seeds(rows, keys, SHOWN_METRICS[:2], _standard_error)
    options = {tuple(row[key] for key in keys): row["options"] for row in rows}
    for row, error in zip(means, errors):
        row["options"] = options[tuple(row[key] for key in keys)]
        row |= {f"{name}_error": error[name] for name in SHOWN_METRICS[:2]}
    return means


def _standard_error(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.std(known, ddof=1) / np.sqrt(len(known))) if len(known) > 1 else None


def _view(camera: Camera, at_ns: int = 0) -> View:
    shot = camera.capture(at_ns)
    k = shot.intrinsics
    image = payload.decode(shot.payload, camera.codec, k.width, k.height)
    return View(camera.name, image, shot.pose.matrix(), k, at_ns)
