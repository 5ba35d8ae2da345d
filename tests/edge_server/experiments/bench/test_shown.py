"""``edge-server bench shown``: every run of a row once, tables that say what was measured."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import yaml

from edge_server.cli import main as edge_server
from edge_server.experiments.bench.shown import growth, output, rows, runs


@pytest.fixture
def small(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scenario of little pixels; fields of little steps."""
    options = {"gaussians": 256, "start": 128, "seed_cells": 8}
    edge = {"field": "splat", "field_options": options, "lpips": "none", "grace_ms": 0.0}
    monkeypatch.setattr(rows, "EDGES", {"layers": {**edge, "updates": "arrivals"}, "before": edge})
    monkeypatch.setattr(runs, "QUICK_SECONDS", 0.6)
    cheap = runs.replace(runs.LAYERS_RUN, steps=1, epoch_ms=100.0)
    monkeypatch.setattr(runs, "LAYERS_RUN", cheap)
    monkeypatch.setattr(runs, "_CYCLE_RUN", runs.replace(cheap, compute=runs.Compute(ms_per_update=200.0)))
    path = tmp_path / "small.yaml"
    source = {"kind": "world", "scene": "room", "width": 24, "height": 24, "params": {"supersample": 1}}
    cameras = {"count": 4, "held_out": ["cam00"]}
    path.write_text(yaml.safe_dump({"cameras": cameras, "source": source, "channel": {"preset": "ch5"}}))
    return path


def test_a_scenario_is_measured_once_and_tabulated(small: Path, capsys) -> None:
    out = small.with_name("present.json")
    words = ["bench", "shown", "--quick", "--scene", str(small), "--json", str(out)]
    assert edge_server(words) == 0
    found: dict[str, Any] = json.loads(out.read_text())["shown"][str(small)]
    assert set(found) == set(runs.VARIANTS) and all(set(runs_of) == {"7"} for runs_of in found.values())
    late, before, ideal = (found[v]["7"] for v in ("shown", "before", "nothing late"))
    assert ideal["age_ms"]["network"] == 0.0 < late["age_ms"]["network"]
    assert before["age_ms"]["computing"] == pytest.approx(200.0) and ideal["age_ms"]["computing"] == 0.0
    assert before["age_ms"]["mean"] > late["age_ms"]["mean"] > ideal["age_ms"]["mean"]
    for run in (late, before, ideal):  # no field is better than the perfect one of the same ages
        perfect = run["perfect"]
        assert run["squared_error"]["moving"] > perfect["newest"]["squared_error"]["moving"]
        assert perfect["newest"]["squared_error"]["moving"] <= perfect["mean"]["squared_error"]["moving"]
    text = out.with_suffix(".md").read_text()
    assert f"| {small} | before | 1 | {before['psnr_db']['whole']:.2f} |" in text
    assert "ms ago; before, " in text and "![shown](shown.png)" in text
    assert out.with_name("shown.png").stat().st_size > 1000
    written = out.read_text()
    assert edge_server([*words, "--resume"]) == 0
    again = json.loads(out.read_text())["shown"]
    assert again == json.loads(written)["shown"], "nothing was measured twice"
    capsys.readouterr()


def test_a_long_run_is_told_minute_by_minute(small: Path, monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    row = rows.Row("long", str(small), split=False, minutes=1, charged_as="as")
    monkeypatch.setattr(rows, "ROWS", (row, rows.Row("as", str(small), split=False)))
    monkeypatch.setattr(runs, "SETTLED_S", 0.2)
    monkeypatch.setattr(runs, "SHOWN_EVERY_MS", 10.0)
    out = small.with_name("present.json")
    words = ["bench", "shown", "--quick", "--json", str(out), "--scene"]
    assert edge_server([*words, "long"]) == 1
    assert "charged as as, which is not known: measure that first" in capsys.readouterr().err
    assert edge_server([*words, "as", "--scene", "long"]) == 0
    found = json.loads(out.read_text())["shown"]
    assert set(found["long"]) == {"shown"}
    run = found["long"]["shown"]["7"]
    assert run["charged"]["ms_per_update"] == found["as"]["nothing late"]["7"]["cost"]["update_ms"]
    assert [part["minute"] for part in run["by_minute"]] == [1]
    assert run["by_minute"][0]["age_ms"] == pytest.approx(run["age_ms"]["mean"])
    assert f"| long (0 frames left out): mean age, ms | {run['age_ms']['mean']:.0f} |" in capsys.readouterr().out


def test_a_slower_processor_is_charged_more_and_compared_with_one_that_stands_still(
    small: Path, monkeypatch: pytest.MonkeyPatch, capsys
) -> None:
    of = rows.Row("as", str(small), split=False)
    slow = rows.Row("slow", str(small), split=False, charged_as="as", slower=4.0)
    for module in (rows, output):
        monkeypatch.setattr(module, "ROWS", (of, slow))
    cost = {"update_ms": 15.0, "view_ms": 1.0}  # the small run ends before its layers cost anything
    monkeypatch.setattr(runs.UpdateCosts, "measured", lambda self, items: cost)
    out = small.with_name("present.json")
    assert edge_server(["bench", "shown", "--quick", "--json", str(out)]) == 0
    found = json.loads(out.read_text())["shown"]
    fast, run = (found[name]["shown"]["7"] for name in ("as", "slow"))
    assert run["charged"]["ms_per_update"] == 4.0 * fast["charged"]["ms_per_update"] == 60.0
    assert run["age_ms"]["mean"] > fast["age_ms"]["mean"]
    # What stands still is late by the whole mean age, what is carried on is not.
    perfect = run["perfect"]
    assert perfect["frozen"]["squared_error"]["moving"] > perfect["mean"]["squared_error"]["moving"]
    text = out.with_suffix(".md").read_text()
    assert f"| as | 0.25 | {run['psnr_db']['whole']:.1f} |" in text and "| slow | layers |" not in text
    capsys.readouterr()


def test_the_shares_add_up_to_what_is_shown() -> None:
    def run(error: float, perfect: float) -> dict[str, Any]:
        return {
            "7": {"squared_error": {"moving": error}, "perfect": {"newest": {"squared_error": {"moving": perfect}}}}
        }

    figures = {"x": {"nothing late": run(2.0, 0.1), "computing free": run(5.0, 1.1), "shown": run(10.0, 4.1)}}
    assert output._shares(figures, "x") == pytest.approx([0.2, 0.4, 0.2, 0.2])  # of 10
    figures["x"].pop("computing free")
    assert output._shares(figures, "x") == []


def test_every_row_can_be_made_and_drawn_ones_follow_from_their_seeds() -> None:
    assert len({row.name for row in rows.ROWS}) == len(rows.ROWS)
    for row in rows.ROWS:
        for edge in rows.EDGES:
            made = row.scenario(9, edge)
            assert made.seed == 9 and made.source["kind"] == "world" and made.held_out == ("cam00",)
    assert rows.drawn(101) == rows.drawn(101) and rows.drawn(101) != rows.drawn(102)
    assert [row.name for row in rows.find(("tower", "cell"))] == ["tower", "cell"]
    assert rows.find(()) == list(rows.ROWS)


def test_a_scene_that_is_not_known_is_refused(tmp_path: Path, capsys) -> None:
    assert edge_server(["bench", "shown", "--quick", "--scene", "fox"]) == 1
    assert "expected a source of kind world" in capsys.readouterr().err


def test_growth_varies_one_factor_at_a_time_and_says_what_saturates(small, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(growth, "_ROOM", (3, 24, 24, 15.0, 1.0, 1))
    monkeypatch.setattr(growth, "POINTS", {"cameras": ({"cameras": 2}, {}), "people": ({"people": 0}, {})})
    monkeypatch.setattr(growth, "SETTINGS", runs.LAYERS_RUN)
    out = tmp_path / "growth.json"
    words = ["bench", "growth", "--quick", "--json", str(out)]
    assert edge_server(words) == 0
    found = json.loads(out.read_text())["growth"]
    room = found["cameras"]["3, 24, 24, 15, 1, 1"]
    assert found["people"]["3, 24, 24, 15, 1, 1"] == room, "measured once"
    assert room["age_ms"] > 0.0 and room["psnr_db"] > 0.0 and room["instants"] >= 5
    assert found["people"]["3, 24, 24, 15, 1, 0"]["psnr_moving_db"] is None
    assert "| people | 3 | 24 x 24 | 15 | 1 | 0 |" in out.with_suffix(".md").read_text()
    assert "No point saturates one core." in growth.table(found)
    room |= {"following_cores": 0.95, "shed": 0.2}
    text = growth.table(found)
    assert "Saturated: 3 cameras of 24 x 24 at 15 frames a second, 1 people at 1 m/s (20% of" in text
    assert out.with_name("growth.png").stat().st_size > 5000
    written = out.read_text()
    assert edge_server([*words, "--resume"]) == 0
    assert json.loads(out.read_text())["growth"] == json.loads(written)["growth"], "nothing was measured twice"


def test_updates_take_in_no_more_frames_than_there_is_time_for() -> None:
    """Two epochs are 40 ms; an update takes 10 of them, a frame 0.5."""
    settings = runs.RunSettings(1, epoch_ms=20.0, compute=runs.Compute(ms_per_update=10.0, ms_per_view=0.5))
    assert settings.most_new == 60
    assert runs.replace(settings, compute=runs.Compute(ms_per_view=100.0)).most_new == 4
    assert runs.replace(settings, compute=runs.Compute()).most_new is None
    assert runs.replace(settings, epoch_ms=0.0).most_new is None
