from __future__ import annotations

import json
import re

import cv2
import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.config import ExportConfig
from edge_server.report import build_report
from edge_server.report.html import render_html
from edge_server.report.report import METRICS, SERIES, assemble, fidelity, updates
from edge_server.report.run_files import read_run_files
from freshfield_up.summary import summarize
from tests.edge_server.report.sample_run import CAMERAS, CHANNEL, SECONDS, publication, write_run


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    write_run(out)
    return out, build_report(out)


def test_report_json_holds_what_is_returned_and_every_documented_key(run):
    out, report = run
    assert json.loads((out / "report.json").read_text()) == report
    assert (report["scenario"], report["seed"], report["seconds"]) == ("sample", 7, SECONDS)
    assert set(report["frames"]) >= {
        "captured",
        "replaced",
        "waiting",
        "sent",
        "skipped",
        "dropped_busy",
        "superseded",
        "lost",
        "broken",
        "duplicated",
        "delivered",
        "rejected",
        "in_flight",
    }
    assert set(report["age_ms"]) == {"mean", "p50", "p95", "by_camera"}
    assert set(report["updates"]) == {
        "count",
        "ms_p50",
        "ms_p95",
        "first_ms",
        "undecodable",
        "shed",
        "without_step",
        "refused",
    }
    assert set(report["fidelity"]["final"]) == set(report["fidelity"]["mean"]) == set(METRICS)
    assert set(report["fidelity"]["baseline"]) == {"mean_colour_db", "nearest_view_db"}
    assert report["fidelity"]["lpips_missing"] is None
    assert all(tuple(row) == SERIES for row in report["fidelity"]["series"])
    assert report["channel"] == CHANNEL
    assert report["versions"]["python"] and report["machine"]["cores"] >= 1
    assert set(report["outside_load"]) == {"cores", "ours", "method"}


def test_frames_close(run):
    frames = run[1]["frames"]
    assert frames["captured"] == 200 == frames["replaced"] + frames["waiting"] + frames["sent"]
    assert (frames["dropped_busy"], frames["delivered"], frames["rejected"]) == (80, 76, {"crc": 4})
    assert frames["closes"] and frames["contradiction_count"] == 0 and frames["ledgers"] == 3


def test_what_was_shown_and_what_its_age_consists_of(run):
    shown = run[1]["fidelity"]["shown"]
    assert [shown[k] for k in ("psnr_db", "psnr_moving_db", "psnr_still_db", "ssim", "lpips")] == [
        24.0,
        17.0,
        26.0,
        0.8,
        None,
    ]
    late = [p for i in range(49) if (p := publication(i)).t_s + 0.1 >= 0.8 * SECONDS]
    age = shown["age_ms"]
    assert shown["count"] == len(late) and age["network"] == 50.0
    assert age["display"] == pytest.approx(100.0)
    assert sum(age.values()) == pytest.approx(np.mean([p.aaoi_ms for p in late]) + 100.0)


def test_final_is_the_mean_of_the_last_fifth_of_the_run(run):
    late = [publication(i) for i in range(49)]
    late = [p.psnr_db for p in late if p.t_s >= 0.8 * SECONDS and p.psnr_db is not None]
    assert run[1]["fidelity"]["final"]["psnr_db"] == pytest.approx(np.mean(late))
    whole = [p.psnr_db for i in range(49) if (p := publication(i)).psnr_db is not None]
    assert run[1]["fidelity"]["mean"]["psnr_db"] == pytest.approx(np.mean(whole))
    assert run[1]["fidelity"]["scored"] == len(whole)


def test_a_field_that_stopped_early_has_no_final_score():
    series = [{"t_s": t, "psnr_db": 20.0} for t in (1.0, 2.0)]
    found = fidelity(series, 60.0, {})
    assert found["final"]["psnr_db"] is None and found["mean"]["psnr_db"] == 20.0


@pytest.mark.parametrize("name", ["", "ledger-node-a-1.tsv", "series.jsonl", "edge.json", "run.json"])
def test_the_command_takes_folders_in_which_a_run_left_something(tmp_path, capsys, name):
    (tmp_path / "field.npz").touch()
    if name:
        (tmp_path / name).touch()
    assert edge_server(["report", str(tmp_path)]) == (0 if name else 2)
    assert (tmp_path / "report.html").exists() == bool(name)
    assert name or f"{tmp_path}: holds none of ledger-*.tsv, series.jsonl," in capsys.readouterr().err


def test_ages_are_time_averages_and_none_without_a_report(run):
    ages = run[1]["age_ms"]
    assert ages["by_camera"]["never"] is None
    means = [ages["by_camera"][c]["mean"] for c in CAMERAS[1:]]
    assert ages["mean"] == pytest.approx(np.mean(means)) and 60.0 < ages["p50"] < ages["p95"]


def test_updates_are_counted_as_the_edge_counted_them(run):
    updates = run[1]["updates"]
    assert updates["count"] == 50  # the last one's line was not written any more
    assert updates["first_ms"] == 3100.0 and updates["undecodable"] == 1
    assert updates["ms_p50"] == 800.0  # of all, not only of those that have a line
    assert updates["refused"] == {"cam02": 3}  # 5, 25 and 45
    assert updates["without_step"] == 0


def test_updates_that_had_no_time_to_learn_are_counted():
    rows = [{"t_s": 0.1 * k, "update_ms": 60.0, "steps": steps} for k, steps in enumerate((0, 3, 0))]
    assert updates(rows, {})["without_step"] == 2
    counted = updates(rows, {"without_step": 40, "refused": {"cam01": 3}})  # also of updates without a row
    assert counted["without_step"] == 40 and counted["refused"] == {"cam01": 3}


def test_the_report_shows_frames_that_were_left_out_and_updates_that_made_no_step(tmp_path):
    write_run(tmp_path)
    edge = json.loads((tmp_path / "edge.json").read_text())
    (tmp_path / "edge.json").write_text(json.dumps(edge | {"updates": edge["updates"] | {"shed": 17}}))
    file = tmp_path / "series.jsonl"
    lines = file.read_text().splitlines()
    idle = [json.dumps(json.loads(line) | {"steps": 0}) for line in lines[:3]]
    file.write_text("\n".join([*idle, *lines[3:]]) + "\n")
    found, page = build_report(tmp_path)["updates"], (tmp_path / "report.html").read_text()
    assert (found["shed"], found["without_step"]) == (17, 3)
    assert "left out for lack of time: 17" in page and "without time for a step: 3" in page


def test_the_report_says_of_how_many_images_the_object_was_cut_out_and_why_not_of_the_others(tmp_path):
    write_run(tmp_path)
    assert "cut out of" not in (build_report(tmp_path) and (tmp_path / "report.html").read_text())
    edge = json.loads((tmp_path / "edge.json").read_text())
    cut = {
        "masked": 41,
        "not_detected": 3,
        "empty_box": 0,
        "empty_mask": 0,
        "full_mask": 1,
        "failed": 0,
        "ms_per_image": 2.4,
    }
    (tmp_path / "edge.json").write_text(json.dumps(edge | {"foreground": cut}))
    assert build_report(tmp_path)["foreground"] == cut
    page = (tmp_path / "report.html").read_text()
    assert "The object was cut out of 41 images, 2 ms each; used whole: 3 (nothing was found in it)" in page
    assert "1 (all of it was found to be the object)" in page


def test_every_figure_is_drawn_and_inside_the_page(run):
    out, _ = run
    names = ["comparison", "fidelity", "ages", "updates", "channel", "processes"]
    assert sorted(p.name for p in out.glob("figure-*.png")) == sorted(f"figure-{n}.png" for n in names)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(names)
    assert "Every frame is accounted for." in page and "LPIPS-alex" in page


def test_a_mesh_is_reported_where_there_is_one(run, tmp_path):
    assert "mesh" not in run[1] and "<h2>Mesh" not in (run[0] / "report.html").read_text()
    measured = {
        "chamfer_mm": 6.926,
        "complete": 0.6074,
        "accuracy_median_mm": 1.1,
        "within_mm": 3.0,
        "target_chamfer_mm": 1.5,
        "target_complete": 0.95,
    }
    mesh = {
        "file": "tile.ply",
        "triangles": 19794,
        "seconds": 11.6,
        "stages_s": {"fuse": 0.4},
        "vertices": 9900,
        "watertight": False,
        "cameras": 18,
    }
    for found in (measured, None):
        write_run(tmp_path)
        (tmp_path / "mesh.json").write_text(json.dumps({**mesh, "measured": found}))
        report = build_report(tmp_path)
        assert report["mesh"] == {**mesh, "measured": found}
        page, last = (tmp_path / "report.html").read_text(), summarize(tmp_path)
        assert ("6.93 mm" in page and "60.7 %" in page) == (found is not None)
        assert ("chamfer 6.93 mm (target 1.5), 61 % of the" in last) == (found is not None)
        assert "tile.ply: 19,794 triangles, made in 12 s" in last


@pytest.mark.parametrize(
    "torn", ['{"file": "a.ply"}', '{"file": "a.ply", "measured": {}, "stages_s": [], "triangles": 1}', "{", "[]"]
)
def test_a_damaged_mesh_file_adds_a_note(tmp_path, torn):
    write_run(tmp_path)
    (tmp_path / "mesh.json").write_text(torn)
    report = build_report(tmp_path)
    assert "mesh" not in report and any("mesh.json left out" in note for note in report["notes"])


@pytest.mark.parametrize("wrong", [{"mesh": "../tile.ply"}, {"mesh": "tile.obj"}, {"mesh": "a.ply", "voxel_mm": 0}])
def test_an_export_that_cannot_be_made_is_refused_when_the_scenario_is_read(wrong):
    with pytest.raises(ValueError, match=next(reversed(wrong))):
        ExportConfig(**wrong)


def test_the_page_loads_nothing_from_elsewhere(run):
    page = (run[0] / "report.html").read_text()
    for foreign in ("http://", "https://", "<script", "<link", "@import", 'src="/'):
        assert foreign not in page


def test_a_report_of_the_same_files_is_the_same(run):
    out, report = run
    before = {p.name: p.read_bytes() for p in out.glob("figure-*.png")}
    again = build_report(out)
    again["outside_load"] = report["outside_load"]
    assert again == report
    assert {p.name: p.read_bytes() for p in out.glob("figure-*.png")} == before


def test_a_killed_run_is_reported_with_notes_on_what_is_torn(tmp_path):
    write_run(tmp_path)
    for name in ("series.jsonl", "ages.jsonl"):
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
    (tmp_path / "channel.json").write_text('{"state_sh')
    (tmp_path / "edge.json").unlink()
    (tmp_path / "rendered.png").write_bytes(b"\x89PNG torn")
    report = build_report(tmp_path)
    notes = " | ".join(report["notes"])
    for part in ("edge.json is missing", "channel.json left out", "series.jsonl: 1 of", "ages.jsonl: 1 of"):
        assert part in notes
    assert report["scenario"] is None and report["updates"]["count"] > 10
    assert report["fidelity"]["final"]["psnr_db"] is not None
    assert not (tmp_path / "figure-comparison.png").exists()
    assert "Missing or damaged files" in (tmp_path / "report.html").read_text()


def test_an_empty_folder_gives_a_report_that_says_so(tmp_path):
    report = build_report(tmp_path)
    assert report["updates"]["count"] == 0 and report["frames"]["captured"] == 0
    assert report["age_ms"] == {"mean": None, "p50": None, "p95": None, "by_camera": {}}
    page = (tmp_path / "report.html").read_text()
    assert "The field was never updated" in page and "No ledgers" in page


def test_no_such_folder_is_an_error_that_names_it(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere is not a folder"):
        build_report(tmp_path / "nowhere")


def test_a_process_that_started_again_goes_on_in_time(tmp_path):
    write_run(tmp_path, publications=5, ages=10)
    line = (tmp_path / "series.jsonl").read_text().splitlines()[0]
    with (tmp_path / "series.jsonl").open("a") as file:
        file.write(line + "\n")
    times = [row["t_s"] for row in read_run_files(tmp_path).series]
    assert times == sorted(times) and len(times) == 6 and times[5] > times[4]


def test_nan_in_a_file_does_not_become_nan_in_the_report(tmp_path):
    write_run(tmp_path, publications=3, ages=3)
    with (tmp_path / "series.jsonl").open("a") as file:
        file.write('{"t_s": 9.0, "psnr_db": NaN, "update_ms": Infinity}\n')
        file.write('{"t_s": NaN}\n{"t_s": "8"}\n[1]\n{}\nnull\n')
    report = assemble(read_run_files(tmp_path))
    json.dumps(report, allow_nan=False)
    assert report["fidelity"]["series"][-1]["psnr_db"] is None
    assert "series.jsonl: 5 of 9 lines unreadable (killed while writing?)" in report["notes"]
    build_report(tmp_path)


DEEP = "[" * 100_000


@pytest.mark.parametrize(
    ("file", "text", "note"),
    [
        ("edge.json", '{"updates": [1], "seed": 3}', "edge.json: updates left out: Expected"),
        ("edge.json", '{"updates": {"refused": 7}, "seed": 3}', "updates left out: Expected"),
        ("edge.json", '{"baseline": "x", "seed": 3}', "edge.json: baseline left out"),
        ("edge.json", '{"data": {"held_out": []}, "kind": "fit", "seed": 3}', None),
        ("edge.json", f'{{"seconds": {10**400}, "seed": 3}}', "edge.json: seconds left out"),
        ("edge.json", DEEP, "edge.json left out: maximum recursion"),
        ("edge.json", "[]", "edge.json left out: Expected `object`"),
        ("channel.json", '{"drawn_delay_ms": {"histogram": [1]}, "state_share": [1]}', "share left out"),
        ("frontier.json", '{"points": [{"effort": "low", "update_ms": [1]}]}', "points left out"),
        ("ages.jsonl", '{"t_s": 1, "age_ms": [5]}', "ages.jsonl: 1 of 1 lines"),
        ("shown.jsonl", '{"t_s": 1, "age_ms": "x"}', "shown.jsonl: 1 of 1 lines"),
        ("series.jsonl", f'{{"t_s": 1, "update_ms": {10**400}}}', "series.jsonl: 1 of 1 lines"),
        ("series.jsonl", f'{{"t_s": {10**400}}}', "series.jsonl: 1 of 1 lines"),
        ("series.jsonl", '{"t_s": 1, "refused": 5}', "series.jsonl: 1 of 1 lines"),
        ("series.jsonl", DEEP, "series.jsonl: 1 of 1 lines"),
        ("processes.jsonl", '{"t_s": {}, "edge": {"cpu": 1}}', "processes.jsonl: 1 of 1 lines"),
        ("processes.jsonl", '{"t_s": 1, "edge": {"cpu": "x"}}', "processes.jsonl: 1 of 1 lines"),
    ],
)
def test_what_should_be_something_else_adds_a_note(tmp_path, file, text, note):
    write_run(tmp_path, publications=2, ages=2)
    (tmp_path / file).write_text(text)
    files = read_run_files(tmp_path)
    report = assemble(files)
    render_html(report, {})
    json.dumps(report, allow_nan=False)
    assert note is None or any(note in each for each in files.notes)
    assert file != "edge.json" or "seed" not in text or report["seed"] == 3


def test_hostile_names_do_not_reach_the_page_as_markup(tmp_path):
    write_run(tmp_path, publications=2, ages=2)
    edge = json.loads((tmp_path / "edge.json").read_text())
    edge["scenario"] = "<script>alert(1)</script>"
    (tmp_path / "edge.json").write_text(json.dumps(edge))
    build_report(tmp_path)
    assert "<script" not in (tmp_path / "report.html").read_text()


def test_scores_on_selected_views_are_called_that(tmp_path):
    write_run(tmp_path, publications=3, ages=3)
    text = (tmp_path / "series.jsonl").read_text().replace('"scored_on": "cam00"', '"scored_on": "selected"')
    (tmp_path / "series.jsonl").write_text(text)
    assert build_report(tmp_path)["fidelity"]["scored_on"] == ["selected"]
    assert "No camera is held out" in (tmp_path / "report.html").read_text()


def test_the_run_stands_beside_the_measured_frontier(tmp_path, monkeypatch):
    from edge_server.report.figures import draw_frontier

    write_run(tmp_path)
    report, path = build_report(tmp_path), tmp_path / "figure-frontier.png"
    assert not draw_frontier(report, read_run_files(tmp_path), path), "a run without one"
    point = {"effort": "low", "update_ms": 50.0, "psnr_db": 20.0, "psnr_moving_db": 16.0}
    for points, drawn in (([point], True), ([], False), ([{}], False), (3, False)):
        (tmp_path / "frontier.json").write_text(json.dumps({"points": points, "about": "f.json"}))
        assert draw_frontier(report, read_run_files(tmp_path), path) == drawn
    at: list[float] = []
    (tmp_path / "frontier.json").write_text(json.dumps({"points": [point], "about": "f.json"}))
    monkeypatch.setattr("matplotlib.axes.Axes.plot", lambda axes, x, *words, **more: at.append(float(x[0])))
    files = read_run_files(tmp_path)
    files.series = files.series[::2]  # a busy edge writes no row for some updates
    assert draw_frontier(report, files, path) and at[-1] == pytest.approx(0.75), "one update to the next"
    assert ((cv2.imread(str(path)) < 200).any(axis=-1)).sum() > 2000, "axes, words and points are drawn"


def test_the_stand_in_distance_is_never_shown_as_lpips(tmp_path, monkeypatch):
    """Where LPIPS is missing, tiles, table and figure name the distance that took its place."""
    from edge_server.report.figures import draw_fidelity
    from edge_server.report.html import render_html

    write_run(tmp_path)
    report = build_report(tmp_path)
    for values in (report["fidelity"]["final"], report["fidelity"]["mean"]):
        values |= {"lpips": None, "perceptual": 0.4321}
    page = render_html(report, {})
    assert "<b>0.432</b><span>perceptual (not LPIPS)</span>" in page
    heads = re.findall(r"<th[^>]*>([^<]*)</th>", page)
    assert [head for head in heads if "LPIPS" in head] == ["LPIPS-alex", "perceptual (not LPIPS)"]

    labels: list[str] = []
    monkeypatch.setattr(
        "matplotlib.axes.Axes.legend", lambda axes, **_: labels.extend(axes.get_legend_handles_labels()[1])
    )
    for row in report["fidelity"]["series"]:
        row["perceptual"], row["lpips"] = row["lpips"], None
    assert draw_fidelity(report, read_run_files(tmp_path), tmp_path / "fidelity.png")
    assert [label for label in labels if "LPIPS" in label] == ["perceptual, not LPIPS (lower is better)"]
