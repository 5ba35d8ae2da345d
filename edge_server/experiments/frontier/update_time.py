"""How long an update should take: fidelity at the present of a moving scene in virtual time, by update time.

The field is warm: it has converged on the first instant and is not reset. A longer update fits its views
better, but they are older when it is published.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.capture import Camera
from edge_server.experiments.common.tables import mean_or_none
from edge_server.experiments.virtual.from_scenario import build_deployment, training_cameras
from edge_server.experiments.virtual.virtual_deployment import Compute, RunSettings, Truth
from edge_server.fidelity.scorer import PerceptualMetric, Score, Scorer
from edge_server.fields import Budget, Field, View
from edge_server.live.state import Publication
from freshfield import payload
from freshfield.scenario import Scenario, parse

# What a viewer sees is sampled this often between publications.
SEEN_EVERY_S = 0.25
# Publications of the first part of a run show the start more than the update time.
_SETTLED_SHARE = 0.25
# To measure the cost of updates: steps of short and long ones, their number, time between their images.
_FEW, _MANY, _UPDATES, _BETWEEN_NS = 4, 20, 5, 250_000_000
METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips")
SEEN = ("seen_psnr_db", "seen_psnr_moving_db")


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

    def scenario(self, speed_m_per_s: float, field: str, options: dict[str, Any], seed: int) -> Scenario:
        """The deployment as a scenario."""
        return parse(
            {
                "name": f"{self.scene} at {speed_m_per_s:g} m/s",
                "seed": seed,
                "cameras": {"count": self.cameras, "held_out": ["cam00"]},
                "source": {
                    "kind": "world", "scene": self.scene, "width": self.size, "height": self.size,
                    "fps": self.fps, "speed_m_per_s": speed_m_per_s,
                },
                "channel": {"preset": self.channel},
                "edge": {
                    "field": field, "field_options": options,
                    "policy": {"name": self.policy, "value": self.policy_value},
                },
            },
            Path("frontier"),
        )  # fmt: skip


class WarmStart:
    """Cameras at one speed, which share their renderings, and a field that has converged on the first
    instant."""

    def __init__(
        self,
        moving: MovingScene,
        speed: float,
        field: str,
        options: dict[str, Any],
        seed: int,
        warm_steps: int,
    ) -> None:
        from edge_server.fields.registry import make_field

        self.scenario = moving.scenario(speed, field, options, seed)
        self.cameras = training_cameras(self.scenario)
        self.field: Field = make_field(field, options, seed=seed)
        self.field.fit([_view(camera) for camera in self.cameras], Budget(steps=warm_steps))
        self._warm = self.field.state()

    def run(
        self, steps: int, compute: Compute, seconds: float, lpips: PerceptualMetric | None = None
    ) -> dict[str, Any]:
        """Updates of ``steps`` for ``seconds`` of virtual time, from the warm field: mean scores."""
        self.field.load_state(self._warm)
        update_s = compute.charge_ns(steps) / 1e9
        # 16 scores give the mean of a run as well as hundreds of them.
        settings = RunSettings(steps, compute=compute, score_every_ms=1e3 * seconds / 16)
        settled_s = _SETTLED_SHARE * seconds
        viewer = ViewerScores(settled_s)
        deployment = build_deployment(
            self.scenario, settings, field=self.field, scorer=Scorer(lpips), cameras=self.cameras,
            on_published=lambda p: viewer.published(p, self.field),
        )  # fmt: skip
        viewer.truth = deployment.truth
        publications = deployment.run(seconds)
        viewer.score_until(seconds)
        scored = [p for p in publications if p.psnr_db is not None and p.t_s >= settled_s]
        return {
            "steps": steps,
            "update_s": update_s,
            "updates": len(publications),
            "scored": len(scored),
            "aaoi_ms": mean_or_none([p.aaoi_ms for p in publications]),
            **{name: mean_or_none([getattr(p, name) for p in scored]) for name in METRICS},
            **viewer.means(),
            "frames": deployment.frames(),
        }


def measure_compute(
    moving: MovingScene, speed: float, field: str, options: dict[str, Any], warm_steps: int
) -> Compute:
    """Time of updates of a warm field on this machine where the scene moves and every image is new:
    ms_per_step for a step, ms_per_update for everything else (reading the images, following motion, a
    snapshot). Medians of ``_UPDATES`` short and as many long updates."""
    start = WarmStart(moving, speed, field, options, 0, warm_steps)
    start.field.warm_up()
    taken: dict[int, list[float]] = {_FEW: [], _MANY: []}
    for number in range(1, 2 * _UPDATES + 3):
        views = [_view(camera, number * _BETWEEN_NS) for camera in start.cameras]
        steps = (_FEW, _MANY)[number % 2]
        began = time.perf_counter()
        start.field.fit(views, Budget(steps=steps))
        start.field.snapshot()
        if number > 2:  # no motion is known in the first of each
            taken[steps].append(1e3 * (time.perf_counter() - began))
    few, many = (statistics.median(taken[steps]) for steps in (_FEW, _MANY))
    ms_per_step = max((many - few) / (_MANY - _FEW), 0.01)
    return Compute(round(ms_per_step, 3), round(max(few - _FEW * ms_per_step, 0.0), 3))


class ViewerScores:
    """Scores at evenly spaced instants of what a viewer sees: the newest publication, up to an update old."""

    def __init__(self, from_s: float) -> None:
        self.truth: Truth | None = None
        self._from_s = from_s
        self._next = 0
        self._shown: Any = None
        self._scores: list[Score] = []

    def published(self, publication: Publication, field: Field) -> None:
        """Score what was shown until now; from now on the new publication is shown."""
        self.score_until(publication.t_s)
        self._shown = field.snapshot()

    def score_until(self, t_s: float) -> None:
        """Score the instants up to ``t_s`` that are still open."""
        while (at_s := self._next * SEEN_EVERY_S) < t_s:
            self._next += 1
            if self._shown is not None and self.truth is not None and at_s >= self._from_s:
                score = self.truth.score(self._shown, round(at_s * 1e9))
                self._scores += [score] if score is not None else []

    def means(self) -> dict[str, float | None]:
        return {name: mean_or_none([getattr(s, name[5:]) for s in self._scores]) for name in SEEN}


def steps_for(update_s: float, compute: Compute) -> int:
    """Optimiser steps that an update of about ``update_s`` has time for, at least one."""
    return max(1, round((update_s * 1e3 - compute.ms_per_update) / compute.ms_per_step))


def best(rows: list[dict[str, Any]], metric: str = "psnr_moving_db") -> dict[str, Any] | None:
    """The row with the highest ``metric``; None where no row has it."""
    known = [row for row in rows if row[metric] is not None]
    return max(known, key=lambda row: row[metric]) if known else None


def mean_over_seeds(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Rows of the same field, effort, speed and planned update time as the mean of their seeds, with the
    standard error of the two PSNRs (None for a single seed)."""
    groups: dict[tuple[str, str, float, float], list[dict[str, Any]]] = {}
    for row in rows:
        key = (row["field"], row["effort"], row["speed_m_per_s"], row["planned_update_s"])
        groups.setdefault(key, []).append(row)
    means = []
    for (field, effort, speed, planned_s), group in groups.items():
        row = {
            "field": field, "effort": effort, "options": group[0]["options"], "speed_m_per_s": speed,
            "planned_update_s": planned_s, "seeds": len(group),
        }  # fmt: skip
        for name in ("update_s", "steps", "updates", "scored", "aaoi_ms", *METRICS, *SEEN):
            row[name] = mean_or_none([r[name] for r in group])
        for name in METRICS[:2]:
            known = [r[name] for r in group if r[name] is not None]
            many = len(known) > 1
            row[f"{name}_error"] = float(np.std(known, ddof=1) / np.sqrt(len(known))) if many else None
        means.append(row)
    return means


def _view(camera: Camera, at_ns: int = 0) -> View:
    shot = camera.capture(at_ns)
    k = shot.intrinsics
    image = payload.decode(shot.payload, camera.codec, k.width, k.height)
    return View(camera.name, image, shot.pose.matrix(), k, at_ns)
