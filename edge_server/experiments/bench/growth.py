"""Measures how cost grows with cameras, image size, speed and people: one factor at a time, from ``room``.

A run in virtual time follows arrivals, as the shipped ``room`` does. At first computing is free and its
processor time is measured; then it is charged, and updates take in no more frames than they have time for.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import msgspec

from edge_server.experiments.common.tables import markdown_table, mean_or_none, number
from edge_server.experiments.engine import Engine
from edge_server.experiments.virtual.costs import UpdateCosts, beside_s
from edge_server.experiments.virtual.from_scenario import build_deployment
from edge_server.experiments.virtual.run_settings import RunSettings
from freshfield.scenario import Scenario, load, parse

FREE_S, SETTLING_S, SCORED_S = 7.0, 1.0, 4.0
SEED = 7
# Steps of the static field: about as many as another core does meanwhile.
SETTINGS = RunSettings(steps=5, epoch_ms=20.0, score_every_ms=None, shown_every_ms=50.0)
# One thread, because the charged costs are those of one core.
EDGE = {
    "field": "splat",
    "field_options": {"layers": True, "threads": 1},
    "policy": {"name": "all"},
    "updates": "arrivals",
    "lpips": "none",
    "grace_ms": 1000.0,
}
_SHED, _BUSY = 0.01, 0.9  # share of shed frames and following cores above which a point is saturated
_SCORES = ("psnr_db", "psnr_moving_db", "psnr_still_db")
_COSTS = ("update_ms", "view_ms", "following_cores", "static_cores")
_ROOM = (12, 128, 128, 15.0, 1.0, 1)
_FACTORS = ("cameras", "width", "height", "fps", "speed, m/s", "people")
# Factor -> points: the values of _FACTORS that differ from those of room.
POINTS: dict[str, tuple[dict[str, float], ...]] = {
    "cameras": ({"cameras": 4}, {"cameras": 6}, {}, {"cameras": 18}, {"cameras": 18, "fps": 30.0}),
    "image": ({"width": 64, "height": 64}, {}, {"width": 320, "height": 240}, {"width": 640, "height": 480}),
    "speed": ({"speed, m/s": 0.3}, {}, {"speed, m/s": 2.0}, {"speed, m/s": 4.0}),
    "people": ({"people": 0}, {}, {"people": 2}, {"people": 3}, {"people": 4}),
}
_TEXT = (
    "From `room` (12 cameras of 128 x 128 at 15 frames a second, one person at 1 m/s, `ch5`, `splat` in "
    "layers on arrivals, one seed) one factor is varied at a time. Virtual time: "
    f"{FREE_S:g} s in which computing is free and its processor time is measured, {SETTLING_S:g} s in which "
    f"it is charged, and {SCORED_S:g} s in which what is shown is scored at seeded random instants. As live, "
    "an update takes in no more new frames than it has time for, and sheds others. Following cores: "
    "share of the time that one core updates what moves; at 1 updates follow each other without a pause. "
    "Static cores: the training of the static field beside it, 5 steps an update here; live it takes what is "
    "left. 18 cameras at 30 frames a second send what 36 send at 15 (the room has 18 viewpoints beside the "
    "held-out one). Of larger images than 182 x 182 (12 cameras) what moves is learned at a half, a quarter "
    "or an eighth."
)


@dataclass(frozen=True)
class Point:
    """A point. values: those of ``_FACTORS``, by name. free_s, settling_s, scored_s: seconds of its three parts."""

    values: Mapping[str, float] = field(default_factory=dict)
    free_s: float = FREE_S
    settling_s: float = SETTLING_S
    scored_s: float = SCORED_S


def measure(engine: Engine, quick: bool) -> dict[str, Any]:
    """Measure {FACTOR: {POINT: figures}}; a point that is in several factors is measured once."""
    seconds = (1.0, 0.2, 0.5) if quick else (FREE_S, SETTLING_S, SCORED_S)
    room = dict(zip(_FACTORS, _ROOM))
    points = {factor: [Point(room | point, *seconds) for point in of] for factor, of in POINTS.items()}
    every = [point for of in points.values() for point in of]
    found = iter(engine.run(measure_point, every, "growth", describe=_describe))
    return {
        factor: {", ".join(f"{v:g}" for v in point.values.values()): next(found) for point in of}
        for factor, of in points.items()
    }


def _describe(point: Point, row: Mapping[str, Any]) -> str:
    values = ", ".join(f"{v:g}" for v in point.values.values())
    return (
        f"{values}: {number(row['psnr_db'])} / {number(row['psnr_moving_db'])} dB, {number(row['age_ms'], 0)} ms, "
        f"{row['following_cores']:.2f} cores, shed {row['shed']:.0%}"
    )


def _scenario(value: Mapping[str, float]) -> Scenario:
    base = load("room", SEED)
    source = {
        **base.source,
        "width": int(value["width"]),
        "height": int(value["height"]),
        "fps": value["fps"],
        "speed_m_per_s": value["speed, m/s"],
        "params": {"people": int(value["people"])},
    }
    return parse(
        {
            "name": "room",
            "seed": SEED,
            "cameras": {"count": int(value["cameras"]) + 1, "held_out": list(base.held_out), "phase": "spread"},
            "source": source,
            "channel": dict(base.channel),
            "edge": EDGE,
        },
        base.path,
    )


def measure_point(point: Point) -> dict[str, Any]:
    """Run one deployment; returns its scores, ages and costs."""
    scenario, settings = _scenario(point.values), SETTINGS
    costs = UpdateCosts()
    deployment = build_deployment(
        scenario, settings, on_published=lambda p: costs.published(deployment.updates, p.t_s >= point.free_s * 2 / 3)
    )
    updates = deployment.updates
    costs.watch(updates.field)
    deployment.run(point.free_s)
    cost = costs.measured(deployment.with_images(tuple(updates.buffer.newest().values())))
    compute = msgspec.structs.replace(settings.compute, ms_per_update=cost["update_ms"], ms_per_view=cost["view_ms"])
    deployment.settings = replace(settings, compute=compute)
    deployment.run(point.settling_s)
    shed, arrivals, beside = updates.buffer.shed, updates.buffer.arrivals, beside_s(updates.field)
    first = len(deployment.shown)
    publications = deployment.run(point.scored_s)
    shown = deployment.shown[first:]
    return {
        **{name: mean_or_none([getattr(score, name) for score in shown]) for name in _SCORES},
        "age_ms": mean_or_none(deployment.shown_age_ms[first:]),
        "instants": len(shown),
        "updates_per_s": len(publications) / point.scored_s,
        "following_cores": sum(p.update_ms for p in publications) / (1e3 * point.scored_s),
        "static_cores": (beside_s(updates.field) - beside) / point.scored_s,
        "shed": (updates.buffer.shed - shed) / max(updates.buffer.arrivals - arrivals, 1),
        **cost,
        "point": dict(point.values),
    }


def table(figures: Mapping[str, Any]) -> str:
    """A text with the saturated points, and a table of all points."""
    head = (
        "varied|cameras|image|frames a second|m/s|people|whole, dB|moving|still|age shown, ms|an update, ms|"
        "a frame, ms|following cores|static cores|updates a second|shed"
    )
    rows, saturated = [], []
    for factor, points in figures.items():
        for found in points.values():
            cameras, width, height, fps, speed, people = found["point"].values()
            rows.append(
                (
                    factor,
                    cameras,
                    f"{width} x {height}",
                    f"{fps:g}",
                    f"{speed:g}",
                    people,
                    *(number(found[name], 1) for name in _SCORES),
                    number(found["age_ms"], 0),
                    *(number(found[name]) for name in _COSTS),
                    number(found["updates_per_s"], 0),
                    f"{found['shed']:.0%}",
                )
            )
            if _is_saturated(found):
                saturated.append(
                    f"{cameras} cameras of {width} x {height} at {fps:g} frames a second, {people} people at "
                    f"{speed:g} m/s ({found['shed']:.0%} of the frames shed)"
                )
    where = f"Saturated: {'; '.join(dict.fromkeys(saturated))}." if saturated else "No point saturates one core."
    return "\n\n".join([_TEXT, where, markdown_table(head.split("|"), rows)])


def _is_saturated(found: Mapping[str, Any]) -> bool:
    return bool(found["shed"] > _SHED or found["following_cores"] > _BUSY)


def draw(figures: Mapping[str, Any], path: Path) -> None:
    """Draw PSNR, shown age and cores against each factor, one column per factor, to ``path`` (PNG)."""
    from edge_server.report.style import CYCLE, INK, figure

    panels = (
        ("shown, dB", {"psnr_db": "whole", "psnr_moving_db": "moving"}),
        ("age shown, ms", {"age_ms": "mean age of the views"}),
        ("cores used", {"following_cores": "what moves", "static_cores": "static field"}),
    )
    with figure(path, len(panels), len(figures), 2.0, sharex="col", sharey="row") as (_, axes):
        for column, (factor, points) in enumerate(figures.items()):
            found = list(points.values())
            for row, (label, series) in enumerate(panels):
                ax = axes[row, column]
                for (key, name), color in zip(series.items(), CYCLE):
                    values = [float("nan") if f[key] is None else f[key] for f in found]
                    ax.plot(range(len(found)), values, marker=".", color=color, label=name)
                    full = [k for k, f in enumerate(found) if _is_saturated(f)]
                    ax.plot(
                        full,
                        [values[k] for k in full],
                        "o",
                        markersize=9,
                        mfc="none",
                        color=INK,
                        label="saturated" if full and key == "psnr_db" else None,
                    )
                if column == 0:
                    ax.set_ylabel(label)
                    ax.legend()
            axes[0, column].set_title(factor)
            axes[-1, column].set_xticks(range(len(found)), [_label(factor, f["point"]) for f in found])
            axes[-1, column].tick_params(axis="x", labelrotation=60)


def _label(factor: str, point: Mapping[str, Any]) -> str:
    if factor == "image":
        return f"{point['width']} x {point['height']}"
    if factor == "cameras":
        return f"{point['cameras']}" + (f" at {point['fps']:g}/s" if point["fps"] != _ROOM[3] else "")
    return f"{point['speed, m/s' if factor == 'speed' else 'people']:g}"
