"""Figures that several studies draw."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from edge_server.experiments.common.drawn_images import draw_images
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.studies import drawing, metric_distortions
from tests.edge_server.experiments.studies.invented import request


def test_the_lowest_panel_alone_names_the_axis(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    metrics, named = ("psnr_db", "ssim", "aaoi_ms"), []
    monkeypatch.setattr(drawing, "label_lines", lambda at, y, x: named.append(x))
    row = {"scene": "room", "channel": "ch5", **dict.fromkeys(metrics, 20.0)}
    table = SeedTable([{**row, "gamma_ms": gamma, "seed": seed} for gamma in (30.0, 60.0) for seed in (0, 1)])
    drawing.curves("mat", "gamma_ms", "maximum age (ms)", metrics, "channel")(request(tmp_path), table)
    assert named == [None, None, "maximum age (ms)"] and (tmp_path / "mat-room-0.png").is_file()


def test_distortions_are_drawn_as_bright_as_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[tuple[str, np.ndarray]] = []
    monkeypatch.setattr(metric_distortions, "draw_images", lambda path, rows: drawn.extend(rows[0][1]))
    metric_distortions._draw(request(tmp_path), SeedTable([]))
    assert [label for label, _ in drawn] == ["reference", *metric_distortions.THESIS]
    np.testing.assert_allclose(drawn[0][1], 255 * metric_distortions._reference(0), atol=1.0)


def test_rows_of_one_image_each_are_drawn(tmp_path: Path) -> None:
    black = np.zeros((4, 6, 3), np.uint8)
    draw_images(tmp_path / "rows.png", [("room", [("reference", black)]), ("tower", [("reference", black)])])
    assert (cv2.imread(str(tmp_path / "rows.png")) < 64).mean() > 0.25, "titles stand beside the images"
