"""Images side by side in a figure."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.experiments import experiment_constants as tuned
from edge_server.matplotlib_figures import figure

Image = NDArray[np.uint8]


def draw_images(path: Path, rows: Sequence[tuple[str, Sequence[tuple[str, Image]]]]) -> None:
    """Draw rows of images (title, [(label, image), ...]), all of one height, to ``path`` (PNG)."""
    columns = max(len(images) for _, images in rows)
    with figure(path, len(rows), columns, height_inch=2.3, dpi=80) as (_, axes):
        for line, (title, images) in zip(axes, rows):
            for at in line:
                at.axis("off")
            for at, (label, image) in zip(line, images):
                width = round(image.shape[1] * tuned.DRAWN_HEIGHT_PX / image.shape[0])
                at.imshow(cv2.resize(image, (width, tuned.DRAWN_HEIGHT_PX), interpolation=cv2.INTER_NEAREST))
                at.set_title(label, fontsize=8, fontweight="normal", loc="center")
            line[0].text(
                -0.06, 0.5, title, rotation=90, va="center", ha="right", fontsize=9, transform=line[0].transAxes
            )
