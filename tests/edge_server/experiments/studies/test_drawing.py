"""Figures of studies: which panels and lines they have."""

from __future__ import annotations

from contextlib import contextmanager

from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.studies import drawing
from tests.edge_server.experiments.studies.invented import request


def test_a_panel_for_each_measured_metric_and_a_line_for_each_policy(tmp_path, monkeypatch):
    drawn = []

    @contextmanager
    def watched(path, rows, **kwargs):
        with figure(path, rows, **kwargs) as (fig, axes):
            yield fig, axes
            drawn.append([[line.get_label() for line in at.get_lines()] for at in axes[:, 0]])

    figure = drawing.figure
    monkeypatch.setattr(drawing, "figure", watched)
    both, level = ["random", "freshest"], {"scene": "room", "seed": 0, "policy": drawing.USE_ALL, "psnr_db": 24.0}
    rows = [
        {"scene": "room", "seed": s, "policy": p, "delay_ms": d, "psnr_db": 20.0 + s, "ssim": None, "lpips": 0.1}
        for s in (0, 1)
        for p in both
        for d in (60.0, 120.0)
    ]
    draw = drawing.curves("delay", "delay_ms", "mean delay, ms", ["psnr_db", "ssim", "lpips"], by="policy")
    draw(request(tmp_path), SeedTable([*rows, level]))
    assert drawn == [[[*both, drawing.USE_ALL], both]]  # nothing measured ssim; use-all has no lpips
    assert [file.name for file in tmp_path.iterdir()] == ["delay-room-0.png"]
