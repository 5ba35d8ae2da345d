"""The report of a run: what it takes from the files, what of them it survives, what it concludes and shows."""

import json
import re
from functools import reduce

import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.fidelity.scorer import METRICS, SELECTED
from edge_server.live.output.journal import Journal
from edge_server.report import figures
from edge_server.report.build_report import assemble, build_report
from edge_server.report.conclusion import conclusion
from edge_server.report.events import events, silences
from edge_server.report.figures import draw_ages, draw_fidelity, draw_frontier
from edge_server.report.report_constants import MOST_EVENTS
from edge_server.report.run_files import continuous, read_run_files
from edge_server.report.run_statistics import SERIES, fidelity, updates
from edge_server.run_records import AgesRow, ChannelChange, EdgeStatus, UpdateCounts, UpdateRow
from freshfield.scenario import NOTHING_HELD_OUT
from freshfield.untrusted import read_json
from freshfield_up.status import summarize
from tests.edge_server.report.sample_run import CAMERAS, CHANNEL, EDGE, SECONDS, page_of, publication, write_run
from tests.support import refusal

ENDED_S = 39.8  # the last sample of ages
LATE_S = 0.8 * ENDED_S + 0.2 * 3.1
"""When the last fifth begins, of the time since the first publication."""


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    out = tmp_path_factory.mktemp("run")
    write_run(out)
    return out, build_report(out)


def assert_says(page: str, *expected: str) -> None:
    """In what it shows."""
    text = re.sub(r"\s+", " ", re.sub(r"<style>.*?</style>|<[^>]*>", " ", page))
    for words in expected:
        assert words in text, words


def edit_edge(out, **more):
    """Change edge.json."""
    (out / "edge.json").write_text(json.dumps(json.loads((out / "edge.json").read_text()) | more))


def test_report_json_holds_what_is_returned_and_every_documented_key(run):
    out, report = run
    assert json.loads((out / "report.json").read_text()) == report
    assert (report["scenario"], report["seed"], report["seconds"]) == ("sample", 7, SECONDS)
    assert report["policy"] == {"name": "threshold", "value": 120.0} and report["kind"] == "live"
    assert set(report["fidelity"]["final"]) == set(report["fidelity"]["mean"]) == set(METRICS)
    assert report["fidelity"]["baseline"] == {"mean_color_db": 14.5, "nearest_view_db": 13.8}
    assert all(tuple(row) == SERIES for row in report["fidelity"]["series"])
    assert report["channel"] == CHANNEL and report["chosen"] is None
    assert [(event["t_s"], event["what"]) for event in report["events"]] == [
        (10.0, "network set: 400 ms, 20 % lost"),
        (12.5, "an operator reset the field"),
        (14.0, "the scenario's network again"),
    ]
    assert report["run"] == {**EDGE["run"], "command": "freshfield demo"}, "of the run, not of the report"
    means = [report["age_ms"]["by_camera"][camera]["mean"] for camera in CAMERAS[1:]]
    assert report["age_ms"]["mean"] == pytest.approx(np.mean(means)) and report["age_ms"]["p50"] > 60.0


def test_what_was_shown_and_what_its_age_consists_of(run):
    shown = run[1]["fidelity"]["shown"]
    scores = [shown[k] for k in ("psnr_db", "psnr_moving_db", "psnr_still_db", "ssim", "lpips")]
    assert scores == [24.0, 17.0, 26.0, 0.8, None]
    late = [p for i in range(49) if (p := publication(i)).t_s + 0.1 >= LATE_S]
    age = shown["age_ms"]
    assert shown["count"] == len(late) and age["network"] == 50.0
    assert age["display"] == pytest.approx(100.0)
    assert sum(age.values()) == pytest.approx(np.mean([p.aaoi_ms for p in late]) + 100.0)


def test_final_is_the_mean_of_the_last_fifth_of_the_run_since_its_first_publication(run, tmp_path):
    scored = [p for i in range(49) if (p := publication(i)).psnr_db is not None]
    late = [p.psnr_db for p in scored if p.t_s >= LATE_S]
    assert run[1]["fidelity"]["final"]["psnr_db"] == pytest.approx(np.mean(late))
    assert run[1]["fidelity"]["mean"]["psnr_db"] == pytest.approx(np.mean([p.psnr_db for p in scored]))
    assert run[1]["fidelity"]["scored"] == len(scored)
    # Kernels were compiled until 35 s, and files were written for 8 s at the end.
    write_run(tmp_path)
    edit_edge(tmp_path, updates={"first_ms": 35_000.0}, uptime_s=ENDED_S + 8.0)
    found = page_of(tmp_path)[0]["fidelity"]
    assert found["late_s"] == pytest.approx(ENDED_S - 0.2 * (ENDED_S - 35.0))
    assert found["shown"]["count"] == sum(publication(i).t_s + 0.1 >= found["late_s"] for i in range(49)) > 0
    # A field that stopped early has no final score.
    stopped = fidelity([UpdateRow(t_s=1.0, psnr_db=20.0)], 48.0, EdgeStatus())
    assert stopped["final"]["psnr_db"] is None and stopped["mean"]["psnr_db"] == 20.0


def test_updates_are_counted_as_the_edge_counted_them(run):
    assert run[1]["updates"] == {
        "count": 50,  # the last one's line was not written any more
        "ms_p50": 800.0,  # of all, not only of those that have a line
        "ms_p95": 900.0,
        "first_ms": 3100.0,
        "undecodable": 1,
        "shed": None,
        "without_step": 0,
        "refused": {"cam02": 3},  # 5, 25 and 45
    }
    rows = [UpdateRow(t_s=0.5 + k, update_ms=60.0 + k) for k in range(3)]
    alone = updates(rows, UpdateCounts())
    assert (alone["count"], alone["ms_p50"], alone["first_ms"]) == (3, 61.0, 500.0)
    again = updates(rows, UpdateCounts(9, 700.0, 800.0, 10.0), restarted=True)  # these times: of the last process alone
    assert (again["count"], again["ms_p50"], again["first_ms"]) == (9, 61.0, 500.0)
    counted = updates(rows, UpdateCounts(without_step=40, refused={"cam01": 3}))  # also of updates without a row
    assert counted["without_step"] == 40 and counted["refused"] == {"cam01": 3}


def test_depth_is_reported_where_there_is_some(run, tmp_path):
    assert "depth" not in run[1] and "depth" not in page_of(run[0])[1]
    write_run(tmp_path)
    found = {"cam01": {"frames": 40, "bytes": 380_000}, "cam02": {"frames": 10, "bytes": 120_000}}
    edit_edge(tmp_path, depth={"cameras": found, "undecodable": 2})
    journal = Journal(tmp_path, lambda: json.loads((tmp_path / "edge.json").read_text()))
    for age_ms in (100.0, 300.0):
        journal.ages(50.0, {"never": None}, {"cam01": age_ms})
    journal.close()
    report, page = page_of(tmp_path)
    ages = {"mean": 200.0, "p50": 200.0, "p95": pytest.approx(290.0)}
    assert report["depth"] == {"frames": 50, "bytes": 500_000, "undecodable": 2, "age_ms": ages, "cameras": found}
    assert report["age_ms"] == run[1]["age_ms"]
    assert "50 frames brought depth, 10.0 kB each; the newest depth was 200 ms old on average" in page


def test_every_figure_is_drawn_and_inside_a_page_that_loads_nothing(run):
    out, _ = run
    names = ["comparison", "fidelity", "ages", "updates", "channel", "processes"]
    assert sorted(p.name for p in out.glob("figure-*.png")) == sorted(f"figure-{n}.png" for n in names)
    page = (out / "report.html").read_text()
    assert page.count("data:image/png;base64,") == len(names)
    for foreign in ("http://", "https://", "<script", "<link", "@import", 'src="/'):
        assert foreign not in page


def test_the_page_says_what_the_report_holds(run):
    assert_says(
        (run[0] / "report.html").read_text(),
        *run[1]["conclusion"],
        "800 ms median of 50 updates 76 frames delivered of 200 captured",
        "shown, last fifth of the run 24.00 17.00 0.8000 –",
        "never never reported",
        "12.5 s: an operator reset the field",
        "Every frame is accounted for. 3 ledgers joined, no contradictions.",
        "cam01 50 10 40 0 20 0 0 0 19 0 0 1",
        "drawn delay (ms) delay error (ms) mean 60.20 – 50 % 41.00 0.10 95 % 180.00 – 99 % – 1.20 largest – 4.00",
    )


def test_a_killed_run_is_reported_with_notes_on_what_is_torn(tmp_path, capsys):
    assert edge_server(["report", str(tmp_path)]) == 2 and "holds none of" in capsys.readouterr().err
    write_run(tmp_path)
    for name in ("series.jsonl", "ages.jsonl"):
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[: len(data) // 2])
    (tmp_path / "channel.json").write_text('{"state_sh')
    (tmp_path / "edge.json").unlink()
    (tmp_path / "rendered.png").write_bytes(b"\x89PNG torn")
    assert edge_server(["report", str(tmp_path)]) == 0
    report = json.loads((tmp_path / "report.json").read_text())
    notes = " | ".join(report["notes"])
    for part in ("edge.json is missing", "channel.json left out", "series.jsonl: 1 of", "ages.jsonl: 1 of"):
        assert part in notes
    assert report["scenario"] is None and report["updates"]["count"] > 10
    assert report["fidelity"]["final"]["psnr_db"] is not None
    assert not (tmp_path / "figure-comparison.png").exists()
    (tmp_path / "empty").mkdir()
    report, page = page_of(tmp_path / "empty")
    assert report["updates"]["count"] == 0 and report["frames"]["captured"] == 0
    assert report["age_ms"] == {"mean": None, "p50": None, "p95": None, "by_camera": {}}
    assert "Not known: edge.json is not in this folder" in page and "No ledgers" in page
    assert "What was shown is not known" in page and "never updated" not in page
    (tmp_path / "empty" / "edge.json").write_text('{"scenario": "room"}')
    assert "Nothing was shown" in (page := page_of(tmp_path / "empty")[1]) and "The field was never updated" in page
    assert not draw_ages(report, read_run_files(tmp_path / "empty"), tmp_path / "none.png")


def test_rows_are_in_order_of_time_also_across_a_restart(tmp_path):
    # The scores of two held-out cameras interleave: no step back is one of a restart if a camera can be that late.
    assert continuous([9.9, 10.05, 10.0, 10.2]) == [9.9, 10.05, 10.0, 10.2]
    assert continuous([6.0, 0.5, 1.5, 1.4, 0.2]) == [6.0, 6.5, 7.5, 7.4, 7.7]
    write_run(tmp_path, publications=5, ages=10)
    for name, extra in (("series", [3.1]), ("shown", [9.9, 10.05, 10.0])):
        with (tmp_path / f"{name}.jsonl").open("a") as file:
            file.writelines(json.dumps({"t_s": t_s}) + "\n" for t_s in extra)
    files = read_run_files(tmp_path)
    assert [row.t_s for row in files.series][-2:] == pytest.approx([6.1, 9.2])
    assert [row.t_s for row in files.shown][-3:] == [9.9, 10.0, 10.05]
    for published in ([], [publication(0)]):  # the first process waited for cameras, and published nothing
        journal = Journal(tmp_path / "again", dict)
        journal.begin()
        for i in range(50):
            journal.ages(0.2 + 0.2 * i, {})
        for each in published:
            journal.published(each)
        journal.close()
    files = read_run_files(tmp_path / "again")
    assert files.restarts_s == [10.0] and [row.t_s for row in files.series] == pytest.approx([10.0 + published[0].t_s])
    (tmp_path / f"again/ledger-edge-edge-{50 * 10**9}.tsv").touch()
    (tmp_path / f"again/ledger-edge-unserved-{90 * 10**9}.tsv").touch()  # its page could not be opened
    files.edge.started_ns = 100 * 10**9  # after 40 s in which no edge ran
    files.channel.changes = [ChannelChange(second * 10**9) for second in (54, 80, 103)]
    assert [event["t_s"] for event in events(files) if "network" in event["what"]] == [4.0, 10.0, 13.0]
    assert files.shown == [] and assemble(files)["fidelity"]["late_s"] == pytest.approx(20.0 - 0.2 * (20.0 - 13.1))


def test_a_held_out_camera_that_moves_is_drawn_and_tabled_at_refined_poses(tmp_path, monkeypatch) -> None:
    write_run(tmp_path)
    so_far = {"now_psnr_db": 23.5, "all_psnr_db": 24.7, "now_ssim": 0.79, "all_ssim": 0.8125, "frames": 9}
    edit_edge(tmp_path, so_far={**so_far, "refined": True})
    lines = []
    monkeypatch.setattr(figures, "label_lines", lambda axes, *_, **__: lines.append(len(axes.lines)))
    for row in ("", json.dumps({"t_s": 3.0, "so_far": so_far})):  # runs of earlier versions kept none
        (tmp_path / "shown.jsonl").write_text(row)
        report, page = page_of(tmp_path)
        assert draw_fidelity(report, read_run_files(tmp_path), tmp_path / "figure.png")
    assert lines[-2:] == [4, 2], "now and so far; two levels to compare with"
    assert_says(page, "0.812 SSIM of the same", "9 held-out frames so far, at refined poses 24.70 0.8125")


@pytest.mark.stability
@pytest.mark.parametrize(
    ("file", "text", "note"),
    [
        ("edge.json", '{"updates": [1]}', "edge.json left out: Expected"),
        ("edge.json", f'{{"seconds": {10**400}}}', "edge.json left out"),
        ("edge.json", "[" * 100_000, "edge.json left out"),
        ("channel.json", '{"drawn_delay_ms": {"histogram": {"edges_ms": [1], "counts": [2]}}}', "do not bound"),
        ("frontier.json", '{"points": [{"update_ms": [1]}]}', "frontier.json left out"),
        ("ages.jsonl", '{"t_s": 1, "age_ms": [5]}', "ages.jsonl: 1 of 1 lines"),
        ("shown.jsonl", '{"t_s": 1, "age_ms": "x"}', "shown.jsonl: 1 of 1 lines"),
        ("series.jsonl", '{"t_s": 1e16}', "series.jsonl: 1 of 1 lines"),
        ("series.jsonl", '{"t_s": 9.0, "psnr_db": NaN}\n{"t_s": "8"}\n[1]\n{}\nnull\n', "series.jsonl: 5 of 5"),
        ("processes.jsonl", '{"t_s": 1, "edge": {"cpu": "x"}}', "processes.jsonl: 1 of 1 lines"),
    ],
)
def test_what_should_be_something_else_adds_a_note(tmp_path, file, text, note):
    write_run(tmp_path, publications=2, ages=2)
    (tmp_path / file).write_text(text)
    report, _ = page_of(tmp_path)
    json.dumps(report, allow_nan=False)
    assert any(note in each for each in report["notes"]), report["notes"]


@pytest.mark.stability
def test_hostile_names_do_not_reach_the_page_as_markup_nor_many_events(tmp_path):
    write_run(tmp_path, publications=2, ages=2)
    evil = "<script>alert(1)</script>"
    many = [{"t_s": t_s, "what": evil} for t_s in (-1.0, *range(3 * MOST_EVENTS))]
    edit_edge(tmp_path, scenario=evil, field=evil, lpips_missing=evil, chosen=evil, events=many)
    (tmp_path / "ages.jsonl").write_text(json.dumps({"t_s": 1, "age_ms": {evil: 3}}) + "\n")
    report, page = page_of(tmp_path)
    assert "<script" not in page and page.count("&lt;script&gt;alert(1)") == 6 + MOST_EVENTS - 2  # two of the channel
    assert len(report["events"]) == MOST_EVENTS and read_json((tmp_path / "report.json").read_text())


def test_the_run_stands_beside_the_measured_frontier(tmp_path, monkeypatch):
    write_run(tmp_path)
    report, path, at = assemble(read_run_files(tmp_path)), tmp_path / "figure-frontier.png", []
    point = {"update_ms": 50.0, "psnr_db": 20.0, "psnr_moving_db": 16.0}
    for points in ([], [{}], [point]):
        (tmp_path / "frontier.json").write_text(json.dumps({"points": points, "about": "f.json"}))
        assert draw_frontier(report, read_run_files(tmp_path), path) == (points == [point])
    monkeypatch.setattr("matplotlib.axes.Axes.plot", lambda axes, x, *words, **more: at.append(float(x[0])))
    files = read_run_files(tmp_path)
    files.series = files.series[::2]  # a busy edge writes no row for some updates
    assert draw_frontier(report, files, path) and at[-1] == pytest.approx(0.75), "one update to the next"


def test_two_runs_are_printed_side_by_side(run, tmp_path, capsys, monkeypatch):
    out, report = run
    write_run(tmp_path / "b")
    monkeypatch.setattr(figures, "draw_all", lambda report, files: {})  # they take seconds
    assert edge_server(["report", str(out), "--beside", str(tmp_path / "b")]) == 0
    rows = {line.split("  ")[0]: line.split()[-2:] for line in capsys.readouterr().out.splitlines()}
    shown = f"{report['fidelity']['final']['psnr_db']:.2f}"
    assert rows["published (dB)"] == [shown, shown] and rows["frames delivered"] == ["76", "76"]
    assert "c: no such folder" in refusal(capsys, edge_server, "report", out, "--beside", tmp_path / "c")


SO_FAR = {"now_psnr_db": 20.0, "all_psnr_db": 23.0, "frames": 9}
TRAINED_ON = {"fidelity.scored_on": ["selected"], "fidelity.final.psnr_db": 17.4, "fidelity.shown.psnr_db": None}


@pytest.mark.parametrize(
    ("changes", "sentence", "words"),
    [
        ({"updates.count": 0}, 0, "Nothing was shown: the field was never updated."),
        (TRAINED_ON, 0, "publications read 17.4 dB on training views, nothing is held out"),
        ({"fidelity.shown.psnr_db": 12.0}, 0, "worse than an image of one mean color, which reads 14.5 dB."),
        ({"fidelity.shown.psnr_db": None, "fidelity.final.psnr_db": None}, 0, "; the newest score, 25.9 dB, is"),
        ({"fidelity.so_far": SO_FAR}, 0, "all 9 so far 23.0 dB"),
        ({"fidelity.shown.age_ms.waiting": 0.0}, 2, "Waiting for an update and computing it were the limit"),
        ({"fidelity.shown.age_ms.display": 10.0}, 2, "The network was the limit: it takes the largest part"),
        ({"fidelity.shown.psnr_still_db": 15.0}, 2, "is little better than one mean color: too few cameras"),
        ({"fidelity.shown.psnr_still_db": 14.0}, 2, "What stands still is no better than one mean color: too few"),
        ({**TRAINED_ON, "fidelity.shown.psnr_still_db": None}, 2, "poses that do not fit, or too short a run"),
        ({"fidelity.shown.psnr_still_db": 15.0, "fidelity.so_far": SO_FAR}, 2, "the limit: it takes"),
        ({"updates.without_step": 3, "updates.count": 50}, 2, "6% of the updates had no time for a step of training"),
        ({}, 0, "read 24.0 dB, 17.0 dB where the scene moves; an image of one mean color reads 14.5 dB."),
        ({}, 1, "(50 ms network, "),
        ({}, 1, "reads 26.0 dB, 9.0 above what moves."),
        ({}, 2, "Showing each image until the next was the limit"),
        ({}, 2, "50% of the frames sent did not pass"),
        ({"updates.shed": 70}, 2, "92% of those delivered were left out for lack of time"),
    ],
)
def test_the_conclusion_follows_the_figures(run, changes, sentence, words) -> None:
    report = json.loads((run[0] / "report.json").read_text())
    for path, value in changes.items():
        *parents, last = path.split(".")
        reduce(dict.__getitem__, parents, report)[last] = value
    assert words in conclusion(report)[sentence]


def test_cameras_that_fall_silent_together_are_one_event() -> None:
    """At 10 s cam01 to cam05 lose the network, all but cam05 until 16 s; cam00 goes on."""
    rows = []
    for t_s in np.arange(0.0, 30.0, 0.2):
        away = [k > 0 and t_s > 10.0 and (k == 5 or t_s < 16.0) for k in range(6)]
        ages = {f"cam0{k}": 1e3 * (t_s - 10.0) if gone else 50.0 for k, gone in enumerate(away)}
        rows.append(AgesRow(float(t_s), {**ages, "never": None}))
    (gone,) = silences(rows)
    assert gone.t_s == pytest.approx(10.0, abs=0.01) and gone.what == "cam01, cam02, cam03 and 2 more: no further frame"
    (back,) = silences([AgesRow(row.t_s, {"cam01": row.age_ms["cam01"]}) for row in rows])
    assert back.what == "cam01: no frame for 5.9 s"


def test_the_age_of_what_was_shown_is_told_without_a_held_out_camera(tmp_path):
    write_run(tmp_path)
    (tmp_path / "shown.jsonl").unlink()
    series = (tmp_path / "series.jsonl").read_text().replace('"scored_on": "cam00"', f'"scored_on": "{SELECTED}"')
    lines = series.replace('"network_ms": null', '"network_ms": 50.0').splitlines()
    again = json.loads(lines[-1])  # of an edge that was killed and resumed from a checkpoint: its number, too
    lines.append(json.dumps(again | {"t_s": again["t_s"] + 0.75}))
    (tmp_path / "series.jsonl").write_text("".join(line + "\n" for line in lines))
    report, page = page_of(tmp_path)
    assert NOTHING_HELD_OUT in page.split("<h2>Age")[0]
    age = report["fidelity"]["shown"]["age_ms"]
    # Updates of some 745 ms follow each other: an image is shown for 750, and counts as old as it is in the middle.
    assert age["network"] == 50.0 and age["computing"] == pytest.approx(757, abs=20)
    assert age["display"] == pytest.approx(375, abs=40)
    assert "(50 ms network, " in summarize(tmp_path)
    assert "ms network" in page
