"""Measures fidelity against seconds of fitting from scratch, for the effort levels of a field, with the
Pareto front."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from edge_server.experiments.common.tables import median_or_none, over_seeds
from edge_server.experiments.scenes.multiview_still import MultiviewStill, score_views
from edge_server.fidelity.scorer import PerceptualMetric, Scorer
from edge_server.fields import Budget
from edge_server.fields.registry import efforts_of, make_field, option_help
from freshfield.machine_load import LoadMeter


@dataclass(frozen=True)
class Effort:
    """A named effort level of a field.

    field: name of the representation.
    options: its options.
    still: whether it is also tried on the still scene, not only on the moving one.
    """

    field: str
    name: str
    options: dict[str, Any]
    still: bool = True

    @property
    def label(self) -> str:
        return f"{self.field} {self.name}"


def efforts(field: str, options: dict[str, Any]) -> list[Effort]:
    """The field's effort levels, cheapest first. If the field supports layers, these are one more level, for
    the moving scene only; layers have no effort levels, because effort sizes the static field, which delays
    no update. ``options`` apply to all levels."""
    layers = [Effort(field, "layers", {"layers": True, **options}, still=False)]
    levels = [Effort(field, level, {"effort": level, **options}) for level in efforts_of(field)]
    return [*(layers if "layers" in option_help(field) else []), *levels]


def fit_from_scratch(
    effort: Effort, still: MultiviewStill, seconds: float, seed: int, lpips: PerceptualMetric | None
) -> dict[str, Any]:
    """Measure one point: fit a new field for ``seconds``; returns its score on the held-out views and its
    cost."""
    model = make_field(effort.field, effort.options, seed=seed)
    model.warm_up()
    load = LoadMeter()
    report = model.fit(still.training, Budget(seconds=seconds))
    outside = load.outside_cores()
    score, _ = score_views(model, still.held_out, Scorer(lpips, background=still.background))
    ms_per_step = 1e3 * report.seconds / max(report.steps, 1)
    return {
        "effort": effort.label,
        "seconds": report.seconds,
        "steps": report.steps,
        "ms_per_step": ms_per_step,
        "rays_per_s": report.rays / max(report.seconds, 1e-9),
        "samples_per_s": report.samples / max(report.seconds, 1e-9),
        "psnr_db": score.psnr_db,
        "ssim": score.ssim,
        "lpips": score.lpips,
        "outside_cores": outside,
    }


def medians(points: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Medians over seeds of the points with the same effort and planned seconds (``planned_s``)."""
    names = (
        "seconds",
        "steps",
        "ms_per_step",
        "rays_per_s",
        "samples_per_s",
        "psnr_db",
        "ssim",
        "lpips",
        "outside_cores",
    )
    return over_seeds(points, ("effort", "planned_s"), names, median_or_none)


def mark_front(rows: Sequence[dict[str, Any]]) -> None:
    """Set ``on_front`` of each row: whether no other row with as little planned time has as high a PSNR."""
    best = float("-inf")
    for row in sorted(rows, key=lambda r: (r["planned_s"], -r["psnr_db"])):
        row["on_front"] = row["psnr_db"] > best
        best = max(best, row["psnr_db"])


def costs(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Milliseconds of a step by effort: medians over all points of the effort."""
    names = dict.fromkeys(row["effort"] for row in rows)
    return {name: statistics.median(r["ms_per_step"] for r in rows if r["effort"] == name) for name in names}
