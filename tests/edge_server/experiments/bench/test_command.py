"""``edge-server bench`` measures, writes and goes on; nothing is measured twice."""

from __future__ import annotations

import json

import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.bench import field as bench_field
from edge_server.experiments.bench import growth
from edge_server.experiments.bench.command import PARTS

TINY = bench_field.Workload(seeds=2, planned_s=(0.1, 0.4), recorded_s=(), rate_repeats=1, size=24, rate_s=0.1)


def bench(part: str, out, *words: str) -> dict:
    assert edge_server(["bench", part, "--quick", "--out", str(out), *words]) == 0
    found: dict = json.loads((out / f"{part}.json").read_text())
    assert found["machine"]["cores"] >= 1 and found["quick"] is True
    return found[part]


def test_a_curve_from_fits_to_table_and_nothing_is_fitted_again(tmp_path, monkeypatch):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    monkeypatch.setattr(bench_field, "QUICK", TINY)
    words = ["--field", "ngp", "--scene", "tile", "--option", "levels=4"]
    figures = bench("field", tmp_path, *words)
    found = figures["tile"]
    row = found[name := "ngp, levels=4"]
    assert row["seeds"] == 2 and list(row["series"]) == ["0.1_s", "0.4_s"]
    assert row["best_db"] == max(point["psnr_db"] for point in row["series"].values())
    assert row["steps_per_s"] > 0.0 and row["render_128_ms"] > 0.0 and found["angle_deg"] >= 15.0
    text = (tmp_path / "field.md").read_text()
    shown = ", ".join(f"{p['seconds']:g}: {p['psnr_db']:.1f}" for p in row["series"].values())
    assert f"| tile | {name} | 2 | {shown} |" in text and "![field](field.png)" in text
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    assert len(lines) == 2 * 2 + 1  # fits and rates; with options the start is not measured

    assert bench("field", tmp_path, *words) == figures
    assert (tmp_path / "results.jsonl").read_text().splitlines() == lines
    monkeypatch.setattr(bench_field, "QUICK", bench_field.Workload(1, (0.1,), (), 2, size=24, rate_s=0.1))
    assert bench("field", tmp_path, *words)["tile"][name]["seeds"] == 1
    assert len((tmp_path / "results.jsonl").read_text().splitlines()) == len(lines) + 1  # the rates of two fits


def test_seconds_to_a_quality_are_of_the_first_point_that_has_it():
    series = [{"fitted_s": s, "psnr_db": db} for s, db in ((0.5, 21.9), (1.0, 25.0), (2.0, 24.0), (4.0, 28.5))]
    found = bench_field._seconds_to_db(series)
    assert found == {"22_db": 1.0, "25_db": 1.0, "28_db": 4.0, "30_db": None}


@pytest.mark.slow
def test_the_start_of_a_representation_is_measured_in_processes_of_its_own():
    found = bench_field.start_up(bench_field.Start("ngp", cold=False))
    assert found["peak_rss_mb"] > 50.0 and 0.0 < found["jit_cached_s"] < 60.0


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


def test_a_part_that_cannot_be_measured_does_not_stop_the_others(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    monkeypatch.setattr(bench_field, "QUICK", TINY)
    words = ["--quick", "--field", "ngp", "--scene", "kitchen", "--out", str(tmp_path)]
    assert edge_server(["bench", "track", "field", *words]) == 1
    told = capsys.readouterr().err
    assert "bench track: kitchen: set FRESHFIELD_DATA" in told and "bench field: kitchen: set FRESHFIELD_DATA" in told


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["speed"], "no part is called speed; there are: field, track"),
        (["field", "--field", "splot"], "no field is called splot; there are: ngp"),
        (["track", "--scene", "attic"], "--scene attic: track knows room, kitchen"),
        (["growth", "--scene", "room"], "growth: takes no --scene"),
        (["scanned", "--field", "ngp"], "scanned: takes no --field"),
        (["field", "--option", "colour=1"], "colour"),
    ],
)
def test_what_means_nothing_to_a_part_is_refused(words, message, capsys):
    with pytest.raises(SystemExit):
        edge_server(["bench", *words])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize("name", PARTS)
def test_every_part_has_its_functions_and_stands_in_the_help(name, capsys):
    assert callable(PARTS[name].function("measure")) and callable(PARTS[name].function("table"))
    with pytest.raises(SystemExit):
        edge_server(["bench", "--help"])
    assert f"\n{name:10} " in capsys.readouterr().out
