"""Figures that several studies draw: curves with their intervals, images side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from edge_server.experiments.common.seed_table import Curve, SeedTable
from edge_server.experiments.common.statistics import interval
from edge_server.experiments.studies.study import METRICS, StudyRequest
from edge_server.experiments.studies.trial import Trial, last_images
from edge_server.report.style import CYCLE, GRAY, figure, label_lines

Image = NDArray[np.uint8]
_HEIGHT = 220  # pixels of an image in a figure


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


def draw_metrics(
    path: Path,
    table: SeedTable,
    x: str,
    axis: str,
    metrics: Sequence[str],
    lines: Sequence[tuple[str, dict]],
    title: str,
    levels: Sequence[tuple[str, dict]] = (),
) -> None:
    """Draw a panel for each of ``metrics`` that was measured, to ``path`` (PNG).

    x, axis: label of the points, and its text.
    lines: (text, labels of the points) of each curve.
    levels: the same of each horizontal line.
    """
    measured = [m for m in metrics if any(row.get(m) is not None for row in table.rows)]
    with figure(path, len(measured), height_inch=2.3 if len(measured) < 6 else 1.8, sharex=True) as (_, axes):
        for at, metric in zip(axes[:, 0], measured):
            for k, (label, labels) in enumerate(lines):
                curve = table.curve(x, metric, **labels)
                if curve:
                    draw_curve(at, curve, label, k)
            for k, (label, labels) in enumerate(levels):
                level = interval(table.values(metric, **labels).values())
                if level.count:
                    style = (":", "--", "-.")[k % 3]
                    at.axhline(level.mean, color=GRAY, linestyle=style, linewidth=1.2, label=label)
            last = metric == measured[-1]
            label_lines(
                at,
                METRICS[metric].label.replace(", ", ",\n"),
                axis if last else None,
                title if metric == measured[0] else None,
            )


def draw_images(path: Path, rows: Sequence[tuple[str, Sequence[tuple[str, Image]]]]) -> None:
    """Draw rows of images (title, [(label, image), ...]), all of one height, to ``path`` (PNG)."""
    columns = max(len(images) for _, images in rows)
    with figure(path, len(rows), columns, height_inch=2.3, dpi=80) as (_, axes):
        for line, (title, images) in zip(axes, rows):
            for at in line:
                at.axis("off")
            for at, (label, image) in zip(line, images):
                width = round(image.shape[1] * _HEIGHT / image.shape[0])
                at.imshow(cv2.resize(image, (width, _HEIGHT), interpolation=cv2.INTER_NEAREST))
                at.set_title(label, fontsize=8, fontweight="normal", loc="center")
            line[0].text(
                -0.06, 0.5, title, rotation=90, va="center", ha="right", fontsize=9, transform=line[0].transAxes
            )


def draw_trials(path: Path, request: StudyRequest, rows: Sequence[tuple[str, Sequence[Trial]]]) -> None:
    """Draw the truth and the last rendering of each trial, one row of images for each (title, trials).

    The values of the trials' policies must be in milliseconds.
    """
    shown = []
    for title, trials in rows:
        images: list[tuple[str, Image]] = []
        for trial in trials:
            truth, rendering, row = last_images(trial, request.folders)
            if not images:
                images.append(("truth at the present", truth))
            text = f"{trial.value:g} ms: {row['views']:.0f} views, {row['psnr_db']:.1f} dB"
            images.append((text, rendering))
        shown.append((title, images))
    if shown:
        draw_images(path, shown)
