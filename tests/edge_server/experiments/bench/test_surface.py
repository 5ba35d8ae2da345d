"""``edge-server bench surface`` measures, prints and goes on where it stopped."""

from __future__ import annotations

import json

import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.bench import surface
from edge_server.experiments.bench.surface import Workload
from edge_server.experiments.scenes.tile_scan import RASTER_M, scan


@pytest.mark.slow
def test_a_small_scan_from_fit_to_table(tmp_path, monkeypatch, capsys):
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    monkeypatch.setattr(surface, "QUICK", Workload(40, (2.0,), (8.0,), ("splat",), (24,)))
    monkeypatch.setattr(surface, "CELL_STEPS", 20)
    monkeypatch.setattr(surface, "scan", lambda size: scan(size, RASTER_M[4:8]))  # 20 of 60 views
    words = ["bench", "surface", "cell", "--quick", "--out", str(tmp_path)]
    assert edge_server(words) == 0
    found = json.loads((tmp_path / "surface.json").read_text())["surface"]
    (exact,) = found["exact"]["meshes"]
    assert exact["chamfer_mm"] < 3.0 and exact["complete"] > 0.8
    cell = json.loads((tmp_path / "cell.json").read_text())["cell"]["24"]
    assert cell["views"] == 51 and 0.0 < cell["exact_chamfer_mm"] < cell["chamfer_mm"]
    (fit,) = found["cases"]["splat"]["fits"]
    assert {(m["depth"], m["method"]) for m in fit["meshes"]} == {
        ("of the field", "tsdf"),
        ("sharpened", "tsdf"),
        ("sharpened", "sdf"),
    }
    # What the pictures agree on is nearer to the truth than what the field made of them.
    assert fit["sharpened"]["median_mm"] < fit["of the field"]["median_mm"]
    rough, sharpened = (
        next(m for m in fit["meshes"] if (m["depth"], m["method"]) == (depth, "tsdf"))
        for depth in ("of the field", "sharpened")
    )
    assert sharpened["chamfer_mm"] < rough["chamfer_mm"]
    assert "| exact |  | exact | tsdf | 8 |" in capsys.readouterr().out
    assert edge_server(words) == 0
    assert json.loads((tmp_path / "surface.json").read_text())["surface"] == found
