"""Measures fidelity against seconds of fitting from scratch, with the Pareto front."""

from __future__ import annotations

import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from camera_node.synthetic.scene import SCENES
from edge_server.experiments.common.tables import median_or_none, over_seeds
from edge_server.experiments.experiment_constants import SCORED_OF_TRAINING
from edge_server.experiments.scenes.multiview_still import WHITE, score_views, synthetic_still
from edge_server.experiments.scenes.recorded import MultiviewStill, load_recorded
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import PerceptualMetric, Scorer
from edge_server.fields import Budget
from edge_server.fields.registry import make_field

_MEDIANS = ("seconds", "steps", "ms_per_step", "psnr_db", "ssim", "lpips")


@dataclass(frozen=True)
class Still:
    """A still scene: the name of a synthetic one, or the path of a data set.

    size: width and height in pixels of a synthetic scene.
    scale: as in ``load_recorded``, for a data set.
    """

    scene: str
    size: int = 128
    scale: float = 1.0

    @property
    def files(self) -> list[Path]:
        """The folder of the data set, if it is one."""
        path = Path(self.scene)
        return [path.parent if path.is_file() else path] if path.exists() else []


@dataclass(frozen=True)
class Fit:
    """A fit of a new field for ``seconds``."""

    still: Still
    field: str
    seconds: float
    seed: int
    options: Mapping[str, Any]


@cache
def views_of(still: Still) -> MultiviewStill:
    """The views of a still scene. Raises ScenarioError or DatasetError."""
    if still.scene in SCENES:
        return synthetic_still(still.scene, size=still.size)
    data = load_recorded(Path(still.scene), scale=still.scale)
    return replace(data, held_out=data.held_out or data.training[:SCORED_OF_TRAINING], background=WHITE)


@cache
def lpips_of(weights: Path | None) -> PerceptualMetric | None:
    """LPIPS with weights from a folder; None without any."""
    return None if weights is None else open_lpips(weights)[0]


def fit_from_scratch(fit: Fit, weights: Path | None = None) -> dict[str, Any]:
    """Measure one point: its score on the held-out views and its cost. weights: folder of LPIPS weights."""
    still = views_of(fit.still)
    model = make_field(fit.field, fit.options, seed=fit.seed)
    model.warm_up()
    report = model.fit(still.training, Budget(seconds=fit.seconds))
    score, _ = score_views(model, still.held_out, Scorer(lpips_of(weights), background=still.background))
    return {
        "seconds": report.seconds,
        "steps": report.steps,
        "ms_per_step": 1e3 * report.seconds / max(report.steps, 1),
        "psnr_db": score.psnr_db,
        "ssim": score.ssim,
        "lpips": score.lpips,
    }


def curves(fits: Sequence[Fit], points: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Medians over seeds of the points with the same field and planned seconds (``planned_s``), with ``on_front``:
    whether no other row with as little planned time has as high a PSNR."""
    rows = [{**point, "field": fit.field, "planned_s": fit.seconds} for fit, point in zip(fits, points)]
    found = over_seeds(rows, ("field", "planned_s"), _MEDIANS, median_or_none)
    mark_front(found)
    return found


def mark_front(rows: Sequence[dict[str, Any]]) -> None:
    """Set ``on_front`` of each row."""
    best = float("-inf")
    for row in sorted(rows, key=lambda r: (r["planned_s"], -r["psnr_db"])):
        row["on_front"] = row["psnr_db"] > best
        best = max(best, row["psnr_db"])


def costs(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Milliseconds of a step by field: medians over all its points."""
    names = dict.fromkeys(row["field"] for row in rows)
    return {name: statistics.median(r["ms_per_step"] for r in rows if r["field"] == name) for name in names}
