"""``edge-server frontier``: repeatable, resumable, and its tables and figures say what was measured."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.frontier import from_scratch, frontier_command, update_time
from edge_server.experiments.frontier.output import recommendation, table
from edge_server.experiments.virtual import costs
from edge_server.live.frontier import read_frontier
from edge_server.settings import ComputeConfig
from tests.edge_server.experiments.sets import SMALL, SMALL_WORDS

TINY = update_time.MovingScene(cameras=4, size=32)
COMPUTE = ComputeConfig(ms_per_step=30.0, ms_per_update=10.0)


def test_an_update_time_point_is_the_same_bit_for_bit_whatever_ran_before():
    medium, layers = (
        update_time.Variant("ngp", False, SMALL),
        update_time.Variant("splat", True, {"gaussians": 64, "start": 32}),
    )
    run = update_time.MovingRun(TINY, 1.0, medium, 5, 0.1, 0.6, COMPUTE, lead_s=0.5)
    first = update_time.run_updates(run)
    update_time.run_updates(replace(run, update_s=0.4))
    assert update_time.run_updates(run) == first
    assert (first["steps"], first["update_s"]) == (3, 0.1) and first["shown_psnr_moving_db"] > 5.0
    longer = update_time.run_updates(replace(run, update_s=0.4))
    assert longer["update_s"] == pytest.approx(0.4)
    assert longer["aaoi_ms"] - first["aaoi_ms"] == pytest.approx(300, abs=90)
    at_arrivals = update_time.run_updates(replace(run, variant=layers, update_s=0.04, compute=ComputeConfig(0.0, 1.0)))
    assert (at_arrivals["steps"], at_arrivals["update_s"]) == (10, 0.04) and at_arrivals["aaoi_ms"] < first["aaoi_ms"]


@pytest.mark.parametrize(("layers", "charged"), [(True, (0.5, 20.0, 2.0)), (False, (0.5, 26.0, 0.0))])
def test_a_cycle_is_charged_a_frame_of_each_camera_and_layers_every_frame(layers, charged, monkeypatch):
    measured = {"ms_per_step": 0.5, "ms_per_update": 20.0, "ms_per_view": 2.0}
    monkeypatch.setattr(costs, "measure", lambda scenario, seconds: {"compute": measured})
    assert (
        tuple(
            update_time.measure_compute(
                update_time.Charged(TINY, 1.0, update_time.Variant("splat", layers, {}))
            ).values()
        )
        == charged
    )


def test_the_front_is_what_nothing_beats_in_both():
    points = [(1.0, 20.0), (2.0, 19.0), (2.0, 25.0), (3.0, 25.0), (4.0, 26.0)]
    rows = [{"planned_s": planned_s, "psnr_db": psnr_db} for planned_s, psnr_db in points]
    from_scratch.mark_front(rows)
    assert [row["on_front"] for row in rows] == [True, False, True, False, True]
    measured = {"field": "ngp", "seconds": 1.0, "steps": 3, "ms_per_step": 2.0, "ssim": 0.5, "lpips": None}
    assert "| ngp | 1.00 | 3 | 2.00 | 20.00 | 0.500 | - | * |" in table([{**rows[0], **measured}])


def test_seeds_are_averaged_with_their_standard_error():
    base = {"speed_m_per_s": 1.0, "planned_update_s": 0.5, "update_s": 0.5, "steps": 4, "aaoi_ms": 100.0}
    base |= {"shown_psnr_moving_db": None, "shown_ssim": 0.5, "shown_lpips": None}
    base |= {"field": "ngp", "layers": False, "options": {"threads": 1}}
    (row,) = update_time.mean_over_seeds([{**base, "shown_psnr_db": 20.0}, {**base, "shown_psnr_db": 22.0}])
    assert row["shown_psnr_db"] == 21.0 and row["shown_psnr_db_error"] == pytest.approx(1.0)
    assert row["shown_psnr_moving_db"] is None and row["shown_psnr_moving_db_error"] is None
    assert row["steps"] == 4 and row["seeds"] == 2


def test_the_last_line_recommends_an_update_time_at_a_persons_speed():
    def row(speed, update_s, whole, moving):
        shown = {"shown_psnr_db": whole, "shown_psnr_moving_db": moving}
        return {"field": "ngp", "options": {}, "speed_m_per_s": speed, "update_s": update_s, **shown}

    rows = [row(1.0, 0.1, 20, 18), row(1.0, 0.4, 22, 17), row(1.0, 2.0, 23, 15), row(3.0, 0.05, 30, 30)]
    assert recommendation(rows) == "for this scene: update_ms: 400"
    assert recommendation([row(1.0, 0.004, 20, 18)]) == "for this scene: update_ms: 10", "the shortest there is"
    assert recommendation([]) == "for this scene: update_ms: any"


@pytest.mark.slow
def test_the_command_measures_writes_and_goes_on(tmp_path, capsys, monkeypatch):
    times_s = {"planned_s": (0.2, 0.4), "update_s": (0.1, 0.4), "run_s": 0.8}
    tiny = replace(frontier_command.QUICK, speeds=(1.0,), size=32, moving=TINY, **times_s)
    monkeypatch.setattr(frontier_command, "QUICK", tiny)
    monkeypatch.setattr("edge_server.experiments.frontier.update_time._COSTS_S", 0.3)
    words = ["frontier", "--quick", "--out", str(tmp_path), *SMALL_WORDS]
    assert edge_server(words) == 0
    first = capsys.readouterr().out
    assert first.splitlines()[-1].startswith("for this scene: update_ms: ")
    for name in ("frontier.png", "updates.png", "frontier.json"):
        assert (tmp_path / name).stat().st_size > 100, name
    data = json.loads((tmp_path / "frontier.json").read_text())
    assert set(data["ms_per_step"]) == {"ngp"} and data["ms_per_step"]["ngp"] > 0
    assert len(data["updates"]) == 2  # two update times
    assert len(read_frontier(tmp_path / "frontier.json", "ngp")) == 2

    # As after Ctrl-C: what is finished is not measured again, the rest is, and nothing else has changed.
    lines = (tmp_path / "results.jsonl").read_text().splitlines()
    assert len(lines) == 2 + 1 + 2  # from scratch, what is charged, updates
    (tmp_path / "results.jsonl").write_text("\n".join(lines[:-1]) + "\n")
    assert edge_server(words) == 0
    again = (tmp_path / "results.jsonl").read_text().splitlines()
    assert again == lines, "virtual time gives the same point again"
    assert json.loads((tmp_path / "frontier.json").read_text())["updates"] == data["updates"]
