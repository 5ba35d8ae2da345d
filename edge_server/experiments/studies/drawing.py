"""Figures that several studies draw: curves with their intervals, pictures side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from edge_server.experiments.common.statistics import Interval
from edge_server.experiments.studies.study import METRICS, Curve, Table, mean_curve
from edge_server.report.style import CYCLE, GREY, figure, label_lines

Image = NDArray[np.uint8]


def draw_curve(
    axes: Axes, curve: Curve, label: str, place: int, marker: str = "o", dashed: bool = False
) -> None:
    """A curve of means with the band of their intervals."""
    xs, ys = mean_curve(curve)
    colour = CYCLE[place % len(CYCLE)]
    axes.plot(xs, [y.mean for y in ys], marker=marker, markersize=3, color=colour, label=label,
              linestyle="--" if dashed else "-")  # fmt: skip
    if all(y.count > 1 for y in ys):
        axes.fill_between(
            xs, [y.low for y in ys], [y.high for y in ys], color=colour, alpha=0.15, linewidth=0
        )


def draw_level(axes: Axes, level: Interval, label: str, dots: str = ":") -> None:
    """A horizontal line: what a policy without a value reaches."""
    if level.count:
        axes.axhline(level.mean, color=GREY, linestyle=dots, linewidth=1.2, label=label)


def draw_metrics(
    path: Path, table: Table, x: str, axis: str, metrics: Sequence[str], lines: Sequence[tuple[str, dict]],
    title: str, levels: Sequence[tuple[str, dict]] = (),
) -> None:  # fmt: skip
    """A panel for each metric that was measured, a line for each (label, labels) of ``lines``, a level for
    each of ``levels``."""
    shown = [m for m in metrics if any(row.get(m) is not None for row in table.rows)]
    with figure(path, len(shown), height_inch=2.3, sharex=True) as (_, axes):
        for at, metric in zip(axes[:, 0], shown):
            for k, (label, labels) in enumerate(lines):
                curve = table.curve(x, metric, **labels)
                if curve:
                    draw_curve(at, curve, label, k, dashed=k >= len(CYCLE))
            for k, (label, labels) in enumerate(levels):
                found = list(table.values(metric, **labels).values())
                draw_level(at, _mean(found), label, (":", "--", "-.")[k % 3])
            last = metric == shown[-1]
            label_lines(at, METRICS[metric][0], axis if last else None, title if metric == shown[0] else None)


def draw_pictures(
    path: Path, rows: Sequence[tuple[str, Sequence[tuple[str, Image]]]], height: int = 220
) -> None:
    """Rows of pictures (title, [(label, image), ...]), all of one height, to ``path`` (PNG)."""
    columns = max(len(pictures) for _, pictures in rows)
    with figure(path, len(rows), columns, height_inch=2.3) as (_, axes):
        for line, (title, pictures) in zip(axes, rows):
            for at in line:
                at.axis("off")
            for at, (label, image) in zip(line, pictures):
                width = round(image.shape[1] * height / image.shape[0])
                at.imshow(cv2.resize(image, (width, height), interpolation=cv2.INTER_NEAREST))
                at.set_title(label, fontsize=8, fontweight="normal", loc="center")
            line[0].text(-0.06, 0.5, title, rotation=90, va="center", ha="right", fontsize=9,
                         transform=line[0].transAxes)  # fmt: skip


def _mean(values: Sequence[float | None]) -> Interval:
    from edge_server.experiments.common.statistics import interval

    return interval(values)
