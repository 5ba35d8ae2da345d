"""The style of all figures: light axes, readable sizes, colors that color-blind readers can tell apart."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")  # figures are files; no display is needed

import matplotlib.pyplot as plt
from cycler import cycler
from matplotlib.axes import Axes
from PIL import Image

from edge_server import edge_constants as tuned

# Okabe and Ito's palette, ordered so that neighbors differ in lightness too.
BLUE, VERMILION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE = "#E69F00", "#56B4E9", "#CC79A7"
INK, GRAY, PALE = "#222222", "#777777", "#E4E4E4"
CYCLE = (BLUE, VERMILION, GREEN, ORANGE, SKY, PURPLE)

_RC: Any = {
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": INK,
    "axes.edgecolor": GRAY,
    "axes.linewidth": 0.8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.prop_cycle": cycler(color=CYCLE),
    "grid.color": PALE,
    "grid.linewidth": 0.8,
    "xtick.color": GRAY,
    "ytick.color": GRAY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "figure.dpi": tuned.FIGURE_DPI,
    "figure.constrained_layout.use": True,
}


@contextmanager
def figure(
    path: Path, rows: int = 1, columns: int = 1, height_inch: float = 2.6, dpi: int = tuned.FIGURE_DPI, **kwargs
) -> Iterator[tuple]:
    """``with figure(path, rows) as (fig, axes):`` draws in the common style and writes ``path`` (PNG).

    axes: array (rows, columns). height_inch: height of a row. kwargs go to ``plt.subplots``.
    """
    with plt.rc_context(_RC):
        fig, axes = plt.subplots(
            rows, columns, figsize=(tuned.FIGURE_WIDTH_INCH, height_inch * rows), squeeze=False, **kwargs
        )
        try:
            yield fig, axes
            drawn = io.BytesIO()
            fig.savefig(drawn, dpi=dpi)
            image = Image.open(drawn).convert("RGB")
            if not any(axis.images for axis in fig.axes):  # curves, no pictures
                # Pillow's own choice, median cut, takes a rare color for its neighbor's.
                image = image.quantize(tuned.FIGURE_COLORS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
            else:
                image = image.quantize(tuned.PICTURE_COLORS, kmeans=tuned.PICTURE_MEANS)
            # Without a creation date, so that the same run draws the same bytes.
            image.save(path, optimize=True)
        finally:
            plt.close(fig)


def label_lines(axes: Axes, y: str, x: str | None = None, title: str | None = None) -> None:
    """Axis labels, a title and, for more than one line, a legend: above the plot, where a phone that shows a part of
    the figure shows it first; of many lines beside it."""
    axes.set_ylabel(y)
    if x:
        axes.set_xlabel(x)
    count = len(axes.get_legend_handles_labels()[0])
    above = 1 < count <= tuned.LEGEND_IN_A_ROW
    if title:
        axes.set_title(title, pad=tuned.LEGEND_ROW_PT if above else None)
    if above:
        axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), borderaxespad=0.2, ncols=count, columnspacing=1.2)
    elif count > 1:
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), borderaxespad=0.2)
