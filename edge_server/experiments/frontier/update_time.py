"""Measures how long an update should take: the shown fidelity of a moving scene in virtual time, by update
time.

The whole deployment runs (``rollouts``), charged what updates take on this machine. A longer update fits its views
better, but they are older when it is published. A field in layers follows arrivals instead: its update time is the
time from one update to the next. What is shown counts once the field has learned the scene.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.tables import mean_or_none, over_seeds
from edge_server.experiments.experiment_constants import FRONTIER_COSTS_S, FRONTIER_LEAD_S, STATIC_STEPS_PER_S
from edge_server.experiments.rollouts.episode import EpisodeFactory
from edge_server.experiments.rollouts.rollout import named, rollout
from edge_server.experiments.rollouts.setting import Setting
from edge_server.experiments.virtual import costs_command
from edge_server.fields.registry import option_help
from edge_server.settings import LEAST_UPDATE_MS, ComputeConfig
from freshfield.scenario import Scenario, parse

# The network of the moving scene, and which views its updates use.
CHANNEL, POLICY = "ch5", "all"
# What a row has of what was shown: the names of ``Outcome``.
SHOWN = ("psnr_db", "psnr_moving_db", "ssim", "lpips")


def field_label(field: str, layers: bool) -> str:
    """A field as tables and figures name it."""
    return f"{field} in layers" if layers else field


@dataclass(frozen=True)
class Variant:
    """A field as it is updated. options: of the field, besides ``layers``."""

    field: str
    layers: bool
    options: Mapping[str, Any]

    @property
    def field_options(self) -> dict[str, Any]:
        """As a scenario has them."""
        return {**self.options, **({"layers": True} if self.layers else {})}


@dataclass(frozen=True)
class MovingScene:
    """The cameras of ``room``, where somebody walks, and their network."""

    cameras: int = 13
    size: int = 96

    def scenario(self, speed_m_per_s: float, variant: Variant, **edge: Any) -> Scenario:
        """The deployment as a scenario. edge: further keys of its edge section."""
        world = {"kind": "world", "scene": "room", "width": self.size, "height": self.size, "fps": 15.0}
        return parse(
            {
                "name": f"room at {speed_m_per_s:g} m/s",
                "cameras": {"count": self.cameras, "held_out": ["cam00"], "phase": "spread"},
                "source": {**world, "speed_m_per_s": speed_m_per_s},
                "channel": {"preset": CHANNEL},
                "edge": {
                    "field": variant.field,
                    "field_options": variant.field_options,
                    "policy": {"name": POLICY},
                    "updates": "arrivals" if variant.layers else "cycle",
                    **edge,
                },
            },
            Path("frontier"),
        )


def variants(fields: Sequence[str], options: Mapping[str, Any]) -> list[Variant]:
    """Each field with ``options``, after the same in layers if it has any."""
    return [
        Variant(name, layers, options)
        for name in fields
        for layers in (True, False)
        if not layers or "layers" in option_help(name)
    ]


@dataclass(frozen=True)
class Charged:
    """What is measured to be charged: updates at one speed."""

    moving: MovingScene
    speed: float
    variant: Variant


def measure_compute(asked: Charged) -> dict[str, float]:
    """The time of updates on this machine, a ``ComputeConfig`` as a mapping (``edge-server costs``)."""
    scenario = asked.moving.scenario(asked.speed, asked.variant)
    found: dict[str, float] = costs_command.measure(scenario, FRONTIER_COSTS_S)["compute"]
    if asked.variant.layers:
        return found
    # An update of a cycle decodes the newest frame of each camera, however many have arrived.
    views_ms = (asked.moving.cameras - 1) * found["ms_per_view"]
    return {**found, "ms_per_update": round(found["ms_per_update"] + views_ms, 3), "ms_per_view": 0.0}


@dataclass(frozen=True)
class MovingRun:
    """Updates of about ``update_s`` for ``seconds`` of virtual time after the lead. compute: what they are charged."""

    moving: MovingScene
    speed: float
    variant: Variant
    seed: int
    update_s: float
    seconds: float
    compute: ComputeConfig
    lead_s: float = FRONTIER_LEAD_S

    @property
    def steps(self) -> int:
        """Optimizer steps of an update: of layers those of its static field meanwhile."""
        if self.variant.layers:
            return max(1, round(STATIC_STEPS_PER_S * self.update_s))
        return steps_for(self.update_s, self.compute)

    def setting(self) -> Setting:
        """The deployment that is run."""
        update_ms = 1e3 * self.update_s if self.variant.layers else LEAST_UPDATE_MS
        scenario = self.moving.scenario(self.speed, self.variant, update_ms=update_ms, steps=self.steps)
        lead_ms, span_ms = 1e3 * self.lead_s, 1e3 * self.seconds
        return Setting(scenario, deployed=True, motions=False, lead_ms=lead_ms, span_ms=span_ms, compute=self.compute)

    def facts(self) -> dict[str, Any]:
        """What a row says of its run."""
        return {
            "field": self.variant.field,
            "layers": self.variant.layers,
            "options": self.variant.field_options,
            "speed_m_per_s": self.speed,
            "planned_update_s": self.update_s,
            "seed": self.seed,
        }


def run_updates(run: MovingRun, weights: Path | None = None) -> dict[str, Any]:
    """What a run has shown, as means. weights: folder of LPIPS weights."""
    variant = run.variant
    about = run.moving, run.speed, variant.field, variant.layers, json.dumps(dict(variant.options), sort_keys=True)
    factory = _factory(*about, weights)
    factory.setting = run.setting()
    whole = rollout(factory, run.seed, named(POLICY))[0].whole
    assert whole is not None  # it is deployed
    charged_s = run.compute.charge_ns(run.steps) / 1e9
    return {
        "steps": run.steps,
        "update_s": max(run.update_s, charged_s) if variant.layers else charged_s,
        "aaoi_ms": whole.aaoi_ms,
        **{f"shown_{name}": getattr(whole, name) for name in SHOWN},
    }


@lru_cache(maxsize=1)  # runs that differ in update time and seed follow each other: they share their renderings
def _factory(
    moving: MovingScene, speed: float, field: str, layers: bool, options: str, weights: Path | None
) -> EpisodeFactory:
    run = MovingRun(moving, speed, Variant(field, layers, json.loads(options)), 0, 1.0, 1.0, ComputeConfig(1.0))
    return EpisodeFactory(run.setting(), Folders(lpips=weights))


def steps_for(update_s: float, compute: ComputeConfig) -> int:
    """Number of optimizer steps for which an update of about ``update_s`` has time, at least one."""
    return max(1, round((update_s * 1e3 - compute.ms_per_update) / max(compute.ms_per_step, 0.01)))


def mean_over_seeds(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Means over seeds of the rows with the same field, in layers or not, speed and planned update time, with the
    standard errors of the two shown PSNRs (None for a single seed)."""
    keys = ("field", "layers", "speed_m_per_s", "planned_update_s")
    shown = [f"shown_{name}" for name in SHOWN]
    means = over_seeds(rows, keys, ("update_s", "steps", "aaoi_ms", *shown), mean_or_none)
    errors = over_seeds(rows, keys, shown[:2], _standard_error)
    options = {tuple(row[key] for key in keys): row["options"] for row in rows}
    for row, error in zip(means, errors):
        row["options"] = options[tuple(row[key] for key in keys)]
        row |= {f"{name}_error": error[name] for name in shown[:2]}
    return means


def _standard_error(values: Iterable[float | None]) -> float | None:
    known = [v for v in values if v is not None]
    return float(np.std(known, ddof=1) / np.sqrt(len(known))) if len(known) > 1 else None
