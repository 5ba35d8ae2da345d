"""Figures that several studies draw: curves with their intervals, images side by side."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from matplotlib.axes import Axes

from edge_server.experiments.common.drawn_images import Image, draw_images
from edge_server.experiments.common.seed_table import Curve, Row, SeedTable
from edge_server.experiments.common.statistics import interval
from edge_server.experiments.studies.study import StudyRequest
from edge_server.experiments.studies.trial import last_images, scene_label, scenes_here, usual_trial
from edge_server.experiments.studies.verdicts import METRICS, NO_DELAY, USE_ALL
from edge_server.matplotlib_figures import CYCLE, GRAY, figure, label_lines


def draw_curve(axes: Axes, curve: Curve, label: str, place: int) -> None:
    """Draw the means of a curve with the band of their intervals.

    place: number of the curve in its panel, which chooses its color and line style.
    """
    xs, ys = list(curve), [interval(values.values()) for values in curve.values()]
    color = CYCLE[place % len(CYCLE)]
    axes.plot(
        xs,
        [y.mean for y in ys],
        marker="o",
        markersize=3,
        color=color,
        label=label,
        linestyle="-" if place < len(CYCLE) else "--",
    )
    if all(y.count > 1 for y in ys):
        axes.fill_between(xs, [y.low for y in ys], [y.high for y in ys], color=color, alpha=0.15, linewidth=0)


Draw = Callable[[StudyRequest, SeedTable], None]
"""Draws a study's figures into the request's folder."""


def curves(
    name: str,
    x: str,
    axis: str,
    metrics: Sequence[str],
    by: str,
    per: Sequence[str] = ("scene",),
    of: str | Mapping[str, str] = "",
    **where: Any,
) -> Draw:
    """Makes a drawing of OUT/NAME-SCENE-N.png for each combination of the labels ``per``: a panel for each measured
    metric against label ``x``, a line for each value of label ``by``, and the levels of use-all and of no delay.

    axis: text of x. of: number of the thesis's figure, also by scene. where: further labels of the points.
    """

    def draw(request: StudyRequest, table: SeedTable) -> None:
        measured = [m for m in metrics if any(row.get(m) is not None for row in table.rows)]
        for number, values in enumerate(table.distinct(*per)):
            here = dict(zip(per, values))
            lines = [(str(v), {**where, **here, by: v}) for (v,) in table.distinct(by)]
            lines = [(v, labels) for v, labels in lines if any(row.get(x) is not None for row in table.where(**labels))]
            if not lines:
                continue
            scene, height_inch = here["scene"], 2.3 if len(measured) < 6 else 1.8
            title = _title(of if isinstance(of, str) else of.get(scene, ""), *values)
            path = request.figure(f"{name}-{scene}-{number}.png", title)
            with figure(path, len(measured), height_inch=height_inch, sharex=True) as (_, axes):
                for at, metric in zip(axes[:, 0], measured):
                    for k, (label, labels) in enumerate(lines):
                        draw_curve(at, table.curve(x, metric, **labels), label, k)
                    for policy, style in ((NO_DELAY, ":"), (USE_ALL, "--")):
                        if (level := _level(table, metric, policy, here)) is not None:
                            at.axhline(level, color=GRAY, linestyle=style, linewidth=1.2, label=policy)
                    text = textwrap.fill(METRICS[metric].label, 20)
                    label_lines(at, text, axis if metric == measured[-1] else None)
                axes[0, 0].set_title(title)

    return draw


def _level(table: SeedTable, metric: str, policy: str, here: Row) -> float | None:
    """The mean of a policy without a value, by those of the labels that its rows have; None if it was not measured
    there, or under several conditions."""
    rows = table.where(policy=policy)
    known = {k: v for k, v in here.items() if k != "policy" and any(k in row for row in rows)}
    found = table.where(policy=policy, **known)
    values = interval(row.get(metric) for row in found)
    return values.mean if values.count == len({row["seed"] for row in found}) > 0 else None


def instants(
    name: str, scenes: Sequence[str], policy: str, values: Sequence[float], channel: Row, of: str = "", **settings: Any
) -> Draw:
    """Makes a drawing of one instant of each scene under some values of a policy, to OUT/NAME-pictures.png: the truth
    and the last rendering of each trial.

    values: in milliseconds. of: number of the thesis's figure. settings: further arguments of ``Trial``.
    """

    def draw(request: StudyRequest, table: SeedTable) -> None:
        own = next(iter(request.channels({"": channel}).values()))
        common: Row = {"seed": 3, "channel": own, "lpips": False, "policy": policy, **settings}
        title, shown = _title(of, policy), []
        for scene in scenes_here(request, scenes):
            images: list[tuple[str, Image]] = []
            for value in values:
                truth, rendering, row = last_images(usual_trial(request, scene, value=value, **common), request.folders)
                if not images:
                    images.append(("truth at the present", truth))
                images.append((f"{value:g} ms: {row['views']:.0f} views, {row['psnr_db']:.1f} dB", rendering))
            shown.append((f"{title}\n{scene_label(scene)}", images))
        draw_images(request.figure(f"{name}-pictures.png", title), shown)

    return draw


def _title(of: str, *labels: Any) -> str:
    """What a figure is called: the thesis's figure, if it is one, and its labels."""
    return ", ".join([*([f"Figure {of}"] if of else []), *map(str, labels)])
