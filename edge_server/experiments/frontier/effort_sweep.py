"""Fidelity against seconds from scratch, for the effort levels of a field, with its Pareto front."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np

from edge_server.experiments.scenes.multiview_still import MultiviewStill, score_views
from edge_server.fidelity.scorer import PerceptualMetric, Scorer
from edge_server.fields import Budget, View
from edge_server.fields.registry import efforts_of, make_field, option_help
from freshfield.machine_load import LoadMeter

# Single options, compared with the level "medium" (full sweep only).
_SINGLE_OPTIONS: dict[str, dict[str, dict[str, Any]]] = {
    "ngp": {
        "fewer samples": {"samples": 96},
        "more samples": {"samples": 288},
        "fewer rays": {"batch_samples": 32768, "rays": 4096},
        "more rays": {"batch_samples": 131072, "rays": 16384},
        "coarse grid": {"finest_resolution": 128},
        "fine grid": {"finest_resolution": 512},
        "more levels": {"levels": 12},
        "wide network": {"hidden": 64},
    }
}


@dataclass(frozen=True)
class Effort:
    """A named way to spend time.

    field: the representation.
    options: its settings.
    divided: training images are divided by this; scores are always of full-size images.
    live: tried on the moving scene, too; still: on the still one.
    """

    field: str
    name: str
    options: dict[str, Any]
    divided: float = 1.0
    live: bool = True
    still: bool = True

    @property
    def label(self) -> str:
        return f"{self.field} {self.name}"


def efforts(field: str, options: dict[str, Any], single_options: bool) -> list[Effort]:
    """The field's effort levels, cheapest first; with ``single_options`` also images of half the size, and
    each of ``_SINGLE_OPTIONS`` alone. Where the field knows layers, these are one more level, of what moves
    only: they have none of their own, because effort sizes the static field, which delays no update.
    ``options`` apply to all of them."""
    levels = [Effort(field, level, {"effort": level, **options}) for level in efforts_of(field)]
    layers = [Effort(field, "layers", {"layers": True, **options}, still=False)] * (
        "layers" in option_help(field)
    )
    if single_options:
        levels += [replace(e, name=f"{e.name}, half size", divided=2.0, live=False) for e in levels]
        levels += [
            Effort(field, n, {**changed, **options}, live=False)
            for n, changed in _SINGLE_OPTIONS.get(field, {}).items()
        ]
    return layers + levels


def downscaled(views: Sequence[View], divided: float) -> tuple[View, ...]:
    """The same views with images and intrinsics divided by ``divided``; colors are weighted by their
    alpha."""
    if divided == 1.0:
        return tuple(views)
    small = []
    for view in views:
        lens = view.intrinsics.scaled(1.0 / divided)
        image = view.image.astype(np.float32)
        if image.shape[2] == 4:
            image[..., :3] *= image[..., 3:] / 255.0
        size = (lens.width, lens.height)
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA).astype(np.float32)
        if image.shape[2] == 4:
            image[..., :3] *= 255.0 / np.maximum(image[..., 3:], 1e-3)
        pixels = np.clip(image + 0.5, 0.0, 255.0).astype(np.uint8)
        small.append(replace(view, image=pixels, intrinsics=lens))
    return tuple(small)


def fit_from_scratch(
    effort: Effort, still: MultiviewStill, seconds: float, seed: int, lpips: PerceptualMetric | None
) -> dict[str, Any]:
    """One point: a new field, ``seconds`` of fitting, its score on the held-out views and its cost."""
    model = make_field(effort.field, effort.options, seed=seed)
    still = replace(still, training=downscaled(still.training, effort.divided))
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
    """Points of the same effort and planned seconds (``planned_s``) over seeds, as their medians."""
    groups: dict[tuple[str, float], list[dict[str, Any]]] = {}
    for point in points:
        groups.setdefault((point["effort"], point["planned_s"]), []).append(point)
    names = ("seconds", "steps", "ms_per_step", "rays_per_s", "samples_per_s", "psnr_db",
             "ssim", "lpips", "outside_cores")  # fmt: skip
    rows = []
    for (effort, planned_s), group in groups.items():
        row: dict[str, Any] = {"effort": effort, "planned_s": planned_s, "seeds": len(group)}
        for name in names:
            known = [p[name] for p in group if p[name] is not None]
            row[name] = statistics.median(known) if known else None
        rows.append(row)
    return rows


def mark_front(rows: Sequence[dict[str, Any]]) -> None:
    """Set ``on_front`` of each row: no row with as little planned time has as high a PSNR."""
    best = float("-inf")
    for row in sorted(rows, key=lambda r: (r["planned_s"], -r["psnr_db"])):
        row["on_front"] = row["psnr_db"] > best
        best = max(best, row["psnr_db"])


def costs(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Milliseconds of a step from scratch by effort: medians over all points of the effort."""
    names = dict.fromkeys(row["effort"] for row in rows)
    return {name: statistics.median(r["ms_per_step"] for r in rows if r["effort"] == name) for name in names}
