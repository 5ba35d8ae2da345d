"""What accuracy costs in time: measured repeatably, told in tables and figures; the best point at a speed."""

import json
from dataclasses import replace

import pytest
from msgspec import structs

from edge_server.cli import main as edge_server
from edge_server.experiments.frontier import from_scratch, frontier_command, update_time
from edge_server.experiments.frontier.output import draw_frontier, draw_updates, recommendation
from edge_server.experiments.virtual import costs_command
from edge_server.live.best_update_time import best_point, read_frontier
from edge_server.matplotlib_figures import CYCLE
from edge_server.run_records import FrontierPoint
from edge_server.settings import ComputeConfig
from tests.edge_server.experiments.sets import SMALL, SMALL_WORDS
from tests.support import axes_drawn, refused

TINY = update_time.MovingScene(cameras=4, size=32)


def test_an_update_time_point_is_the_same_bit_for_bit_whatever_ran_before():
    medium = update_time.Variant("ngp", False, SMALL)
    layers = update_time.Variant("splat", True, {"gaussians": 64, "start": 32})
    run = update_time.MovingRun(TINY, 1.0, medium, 5, 0.1, 0.6, ComputeConfig(30.0, 10.0), lead_s=0.5)
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
    monkeypatch.setattr(costs_command, "measure", lambda scenario, seconds: {"compute": measured})
    of = update_time.Charged(TINY, 1.0, update_time.Variant("splat", layers, {}))
    assert tuple(update_time.measure_compute(of).values()) == charged


def test_layers_charge_the_steps_of_their_still_field_one_at_least():
    run = update_time.MovingRun(
        TINY, 1.0, update_time.Variant("splat", True, {}), 5, 0.1, 0.6, ComputeConfig(30.0, 10.0)
    )
    a_second = replace(run, update_s=1.0).steps
    assert replace(run, update_s=0.5).steps == a_second / 2 > 2 and replace(run, update_s=1e-4).steps == 1


def test_the_front_is_what_nothing_beats_in_both():
    points = [(1.0, 20.0), (2.0, 19.0), (2.0, 25.0), (3.0, 25.0), (4.0, 26.0)]
    rows = [{"planned_s": planned_s, "psnr_db": psnr_db} for planned_s, psnr_db in points]
    from_scratch.mark_front(rows)
    assert [row["on_front"] for row in rows] == [True, False, True, False, True]


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


def curves(ax):
    return {line.get_label(): (line.get_color(), line.get_linestyle(), line.get_xydata().tolist()) for line in ax.lines}


def test_figures_show_what_was_measured_and_encircle_the_best(tmp_path, monkeypatch):
    drawn = axes_drawn(monkeypatch)
    rows = [
        {"field": field, "layers": layers, "speed_m_per_s": speed, "planned_update_s": at, "update_s": at}
        | {"shown_psnr_db": 20 + speed + at, "shown_psnr_moving_db": 15 + speed - at}
        for field, layers, speed, at in [("ngp", False, 1, 2.0), ("ngp", False, 1, 0.5), ("splat", True, 3, 1.0)]
    ]
    draw_updates(tmp_path / "updates.png", rows)
    slow, fast, slow_moving, _ = drawn.pop()
    assert curves(slow) == {
        "ngp": (CYCLE[0], "-", [[0.5, 21.5], [2.0, 23.0]]),
        "splat in layers": (CYCLE[1], "--", []),
        "best": ("#222222", "None", [[2.0, 23.0]]),
    }
    assert curves(fast)["splat in layers"][2] == [[1.0, 24.0]] and curves(slow_moving)["best"][2] == [[0.5, 15.5]]
    assert (slow.get_title(loc="left"), fast.get_title(loc="left")) == ("1 m/s", "3 m/s")
    assert slow_moving.get_xlabel() and not slow.get_xlabel() and slow_moving.get_xticks().tolist() == [0.5, 1.0, 2.0]

    rows = [
        {"field": "ngp", "planned_s": s, "seconds": s, "psnr_db": db, "ssim": 0.5, "lpips": None, "on_front": front}
        for s, db, front in [(2.0, 22.0, True), (0.5, 20.0, True), (1.0, 19.0, False)]
    ]
    draw_frontier(
        tmp_path / "frontier.png", rows, {"scene": "tile", "ms_per_step": {"ngp": 0.25}, "lpips_network": None}
    )
    psnr, ssim = drawn.pop()
    ngp, front = curves(psnr)["ngp (0.2 ms a step)"][2], curves(psnr)["Pareto front"][2]
    assert (ngp, front) == ([[0.5, 20.0], [1.0, 19.0], [2.0, 22.0]], [[0.5, 20.0], [2.0, 22.0]])
    assert "tile" in psnr.get_title(loc="left") and "Pareto front" not in curves(ssim) and ssim.get_xlabel()
    assert "higher" in ssim.get_ylabel() and (tmp_path / "frontier.png").stat().st_size > 1000


@pytest.mark.slow
def test_the_command_measures_writes_and_goes_on(tmp_path, capsys, monkeypatch):
    times_s = {"planned_s": (0.2, 0.4), "update_s": (0.1, 0.4), "run_s": 0.8}
    tiny = replace(frontier_command.QUICK, speeds=(1.0,), size=32, moving=TINY, **times_s)
    monkeypatch.setattr(frontier_command, "QUICK", tiny)
    monkeypatch.setattr("edge_server.experiments.frontier.update_time.FRONTIER_COSTS_S", 0.3)
    words = ["frontier", "--quick", "--out", str(tmp_path), *SMALL_WORDS]
    assert edge_server(words) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("for this scene: update_ms: ")
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


# Milliseconds an update, dB of the whole image and of what moves, meters a second.
WALKED = [(100.0, 20.0, 18.0, 1.0), (400.0, 21.0, 17.5, 1.0), (400.0, 24.0, 17.0, 1.0), (2000.0, 24.5, 14.0, 1.0)]
POINTS = [FrontierPoint(*point) for point in (*WALKED, (100.0, 19.0, 17.0, 4.0), (400.0, 19.0, 13.0, 4.0))]


def test_of_points_that_seeds_cannot_tell_apart_the_quickest_is_chosen():
    assert best_point(POINTS, 1.0) == POINTS[2], "longer updates show an older world"
    assert best_point(POINTS, 3.0) == POINTS[4], "the speed nearest in ratio"
    unsure = [structs.replace(p, error_db=1.0) for p in POINTS]  # the best leads by 1.5, of which 1.4 may be chance
    assert best_point(unsure, 1.0) == unsure[2]
    unsure = [structs.replace(p, error_db=1.2) for p in POINTS]
    assert best_point(unsure, 1.0) == unsure[0]
    assert best_point(unsure, 3.0) == unsure[4]


def test_points_are_read_and_errors_say_what_to_do(tmp_path):
    shipped = read_frontier(None, "ngp")
    assert len({p.update_ms for p in shipped}) >= 2 and all(p.update_ms > 0 for p in shipped)
    refused(ValueError, "edge-server frontier --field nothing", read_frontier, None, "nothing")
    for text in ("", "[]", '{"updates": [{}]}', '{"updates": [], "updates": []}'):
        (tmp_path / "f.json").write_text(text)
        refused(ValueError, r"f\.json: not a frontier", read_frontier, tmp_path / "f.json", "ngp")
    row = {"field": "splat", "options": {}, "speed_m_per_s": 1.0, "update_s": 0.1, "psnr_db": 30.0}
    row |= {"psnr_moving_db": 20.0, "shown_psnr_db": 25.0, "shown_psnr_moving_db": 15.0}
    layers = row | {"options": {"layers": True}, "shown_psnr_db": 29.0}
    (tmp_path / "f.json").write_text(json.dumps({"updates": [row, layers]}))
    (plain,), (layered,) = (read_frontier(tmp_path / "f.json", "splat", layers=known) for known in (False, True))
    assert plain.psnr_db == 25.0 and plain.mean_db == 20.0, "by what was shown"
    assert layered.psnr_db == 29.0
