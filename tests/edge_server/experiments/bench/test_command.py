"""``edge-server bench`` measures, writes and goes on; nothing is measured twice."""

from __future__ import annotations

import json

import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.bench import growth


@pytest.mark.slow
def test_growth_measures_a_point_once_and_shows_it_in_every_factor(tmp_path, monkeypatch):
    small = {"width": 24, "height": 24, "cameras": 4}
    points = {"cameras": (small, {**small, "cameras": 3}), "people": (small, {**small, "people": 2})}
    monkeypatch.setattr(growth, "POINTS", points)
    assert edge_server(["bench", "growth", "--quick", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "growth.json").read_text())["growth"]
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 3
    same = "4, 24, 24, 15, 1, 1"
    assert found["cameras"][same] == found["people"][same] and found["people"][same]["view_ms"] > 0.0
    assert "| cameras | 3 | 24 x 24 | 15 | 1 | 1 |" in (tmp_path / "growth.md").read_text()
    assert (tmp_path / "growth.png").stat().st_size > 1000


def test_a_point_is_saturated_where_frames_are_shed_or_one_core_is_full():
    assert growth._is_saturated({"shed": 0.02, "following_cores": 0.1})
    assert growth._is_saturated({"shed": 0.0, "following_cores": 0.95})
    assert not growth._is_saturated({"shed": 0.01, "following_cores": 0.9})
