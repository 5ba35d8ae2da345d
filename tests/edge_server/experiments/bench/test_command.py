"""``edge-server bench`` measures, writes and goes on; nothing is measured twice."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.bench import field as bench_field
from edge_server.experiments.bench import growth
from tests.edge_server.experiments.sets import write_recording

TINY = bench_field.Workload(seeds=2, planned_s=(0.1, 0.4), recorded_s=(0.1,), size=24)


def bench(part: str, out, *words: str) -> dict:
    assert edge_server(["bench", part, "--quick", "--out", str(out), *words]) == 0
    found: dict = json.loads((out / f"{part}.json").read_text())
    assert found["machine"]["cores"] >= 1 and found["quick"] is True
    return found[part]


def test_a_curve_from_fits_to_table_and_nothing_is_fitted_again(tmp_path, monkeypatch):
    write_recording(tmp_path / "data" / "blender_kitchen", cameras=5, instants=1, size=24)
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path / "data"))
    monkeypatch.setattr(bench_field, "QUICK", TINY)
    words = ["--field", "ngp", "--scene", "tile,kitchen", "--option", "levels=4"]
    figures = bench("field", tmp_path, *words)
    found = figures["tile"]
    row = found[name := "ngp, levels=4"]
    assert row["seeds"] == 2 and [point["planned_s"] for point in row["series"]] == [0.1, 0.4]
    assert row["best_db"] == max(point["psnr_db"] for point in row["series"])
    assert found["angle_deg"] >= 15.0 and figures["kitchen"]["scene"].endswith("4 views of 24 x 24")
    text = (tmp_path / "field.md").read_text()
    shown = ", ".join(f"{p['planned_s']:g}: {p['psnr_db']:.1f}" for p in row["series"])
    assert f"| tile | {name} | 2 | {shown} |" in text and "![field](field.png)" in text
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    assert len(lines) == 2 * 2 + 1

    assert bench("field", tmp_path, *words) == figures
    assert (tmp_path / "results.jsonl").read_text().splitlines() == lines
    monkeypatch.setattr(bench_field, "QUICK", replace(TINY, seeds=3))
    assert bench("field", tmp_path, *words)["tile"][name]["seeds"] == 3
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == len(lines) + 2


def test_seconds_to_a_quality_are_of_the_first_point_that_has_it():
    series = [{"seconds": s, "psnr_db": db} for s, db in ((0.5, 21.9), (1.0, 25.0), (2.0, 24.0), (4.0, 28.5))]
    assert bench_field.seconds_to_db(series) == {"22_db": 1.0, "25_db": 1.0, "28_db": 4.0, "30_db": None}


@pytest.mark.slow
def test_growth_measures_a_point_once_and_shows_it_in_every_factor(tmp_path, monkeypatch, capsys):
    small = {"width": 24, "height": 24, "cameras": 4}
    points = {"cameras": (small, {**small, "cameras": 3}), "people": (small, {**small, "people": 2})}
    monkeypatch.setattr(growth, "POINTS", points)
    found = bench("growth", tmp_path)
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == 3
    same = "4, 24, 24, 15, 1, 1"
    assert found["cameras"][same] == found["people"][same] and found["people"][same]["view_ms"] > 0.0
    assert "| cameras | 3 | 24 x 24 | 15 | 1 | 1 |" in (tmp_path / "growth.md").read_text()
    assert (tmp_path / "growth.png").stat().st_size > 1000


def test_a_point_is_saturated_where_frames_are_shed_or_one_core_is_full():
    assert growth._is_saturated({"shed": 0.02, "following_cores": 0.1})
    assert growth._is_saturated({"shed": 0.0, "following_cores": 0.95})
    assert not growth._is_saturated({"shed": 0.01, "following_cores": 0.9})


def test_a_scene_that_was_asked_for_and_is_not_there_is_said(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    assert edge_server(["bench", "field", "--quick", "--scene", "kitchen", "--out", str(tmp_path)]) == 1
    assert "bench field: kitchen: set FRESHFIELD_DATA" in capsys.readouterr().err
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path))
    assert edge_server(["bench", "field", "--quick", "--scene", "kitchen", "--out", str(tmp_path)]) == 1
    assert "there is no " in capsys.readouterr().err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["speed"], "no part is called speed; there are: field, growth"),
        (["field", "--field", "splot"], "no field is called splot; there are: ngp"),
        (["--scene", "attic"], "--scene attic: field knows tile, room, kitchen"),
        (["growth", "--scene", "room"], "growth: takes no --field, --scene"),
        (["field", "--option", "colour=1"], "colour"),
    ],
)
def test_what_means_nothing_to_a_part_is_refused(words, message, capsys):
    with pytest.raises(SystemExit):
        edge_server(["bench", *words])
    assert message in capsys.readouterr().err
