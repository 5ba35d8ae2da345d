"""Images side by side in a figure."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from edge_server.experiments.common.drawn_images import draw_images


def test_rows_of_one_image_each_are_drawn(tmp_path: Path) -> None:
    black = np.zeros((4, 6, 3), np.uint8)
    draw_images(tmp_path / "rows.png", [("room", [("reference", black)]), ("tower", [("reference", black)])])
    assert (cv2.imread(str(tmp_path / "rows.png")) < 64).mean() > 0.1
