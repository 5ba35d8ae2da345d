"""Which folders a run may use, since a mistyped --out must never cost anybody a file; and the line that the launcher
prints, from status files as the processes write them."""

import json

import pytest

from freshfield_up.folder import EARLIER, KEY, MARKER, FolderError, forget_earlier, prepare
from freshfield_up.status import status_line
from freshfield_up.summary import summarize
from tests.support import refused


def test_an_earlier_run_outlives_starts_that_fail(tmp_path):
    prepare(tmp_path, {"run": 1}).close()
    (tmp_path / "report.json").write_text("good")
    for failed in (2, 3):
        prepare(tmp_path, {"run": failed}).close()
        (tmp_path / "log-edge.txt").write_text(f"start {failed} failed")
    assert [p.name for p in (tmp_path / EARLIER).iterdir()] == ["report.json"]
    assert {p.name for p in tmp_path.iterdir()} == {MARKER, EARLIER, "log-edge.txt"}


def test_a_start_that_is_killed_before_its_marker_is_written_or_while_it_moves_files_loses_none(tmp_path):
    (tmp_path / MARKER).touch()
    prepare(tmp_path, {"run": 1}).close()
    for name in ("field.npz", "edge.json"):
        (tmp_path / name).write_text(name)
    part = tmp_path / f".{EARLIER}"
    part.mkdir()
    (tmp_path / "edge.json").rename(part / "edge.json")
    prepare(tmp_path, {"run": 2}).close()
    assert {p.name for p in (tmp_path / EARLIER).iterdir()} == {"field.npz", "edge.json"} and not part.exists()


def test_an_earlier_run_is_replaced_and_a_link_in_it_is_not_followed(tmp_path):
    precious = tmp_path / "precious"
    precious.mkdir()
    (precious / "photo").write_text("keep")
    out = tmp_path / "out"
    prepare(out, {"run": 1}).close()
    for name in ("ledger-edge-edge-1.tsv", "frontier.json", ".edge.json.4f.part"):
        (out / name).write_text("old")
    (out / "decisions").symlink_to(precious)
    prepare(out, {"run": 2}).close()
    forget_earlier(out)
    assert list(out.iterdir()) == [out / MARKER] and (precious / "photo").read_text() == "keep"
    assert json.loads((out / MARKER).read_text()) == {KEY: [], "run": 2}


@pytest.mark.parametrize(
    ("marker", "error"),
    [
        (None, "not an earlier run's"),
        (json.dumps({KEY: [1]}), "not of a run of this version"),
        ("", "not of a run of this version"),
        (json.dumps({KEY: []}), "holds thesis.tex, which no run wrote"),
    ],
)
def test_anything_else_is_refused_and_left_alone(tmp_path, marker, error):
    (tmp_path / "thesis.tex").write_text("years of work")
    (tmp_path / "edge.json").write_text("{}")
    if marker is not None:
        (tmp_path / MARKER).write_text(marker)
    before = {path.name: path.read_text() for path in tmp_path.iterdir()}
    refused(FolderError, error, prepare, tmp_path, {})
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == before


def test_a_run_that_is_still_going_on_and_a_file_in_the_place_of_the_folder_are_refused(tmp_path):
    with prepare(tmp_path, {"run": 1}), pytest.raises(FolderError, match="another run is writing"):
        prepare(tmp_path, {"run": 2})
    assert json.loads((tmp_path / MARKER).read_text()) == {KEY: [], "run": 1}
    refused(FolderError, "cannot use", prepare, tmp_path / MARKER, {})


EDGE = {
    "cameras": [{"camera": f"cam{i:02d}", "age_ms": 80.0 + 300 * i} for i in range(13)],
    "policy": "all",
    "updates": {"count": 9, "ms_p50": 812.0},
    "scores": {"psnr_db": 25.125, "psnr_moving_db": None},
    "last": {"aaoi_ms": 512.0},
}
CHANNEL = {
    "preset": "ch6-slow",
    "state": "high",
    "state_share": {"low": 0.25, "high": 0.75},
    "counts": {"forwarded": 481, "dropped_busy": 0, "superseded": 17},
    "delay_error_ms": {"p99": 0.123},
}


def test_the_line_says_what_the_processes_wrote(tmp_path):
    (tmp_path / "edge.json").write_text(json.dumps(EDGE))
    (tmp_path / "channel.json").write_text(json.dumps(CHANNEL))
    assert status_line(tmp_path, 13) == (
        "13/13 cameras, age 1880 ms (median); 9 updates, 812 ms each, PSNR 25.12 dB, moving - dB, "
        "views used 512 ms old, policy all; "
        "ch6-slow, state high (75% of the time), forwarded 481, superseded 17, delay error p99 0.12 ms"
    )

    so_far = {"now_psnr_db": 24.0, "all_psnr_db": 25.0, "frames": 9, "refined": True}
    (tmp_path / "edge.json").write_text(json.dumps({"updates": {"count": 2}, "so_far": so_far, "scores": {}}))
    said = "held out now 24.00 dB, all 9 frames so far 25.00 dB, at refined poses, policy"
    assert said in status_line(tmp_path, 2)


def test_missing_and_damaged_status_files_leave_gaps(tmp_path):
    assert status_line(tmp_path, 13) == "0/13 cameras; no update yet; no channel yet"
    (tmp_path / "channel.json").write_text("[1, 2")
    (tmp_path / "edge.json").write_text(json.dumps({"cameras": "none", "updates": {"count": "many"}}))
    assert status_line(tmp_path, 13) == "0/13 cameras; no update yet; no channel yet"


def test_the_summary_is_the_conclusion_and_whether_all_frames_are_accounted_for(tmp_path):
    lost = {"closes": False, "doubts": ["2,014 lines of the ledgers were lost", "another"]}
    for found, expected in (
        ({"closes": True, "cut_off": 2}, "; all accounted for, 2 of them cut off by the end of a process\n"),
        (lost, "; NOT ALL ACCOUNTED FOR: 2,014 lines of the ledgers were lost; another\n"),
    ):
        frames, sentences = {"captured": 3, "sent": 3, "delivered": 3, "rejected": {}, **found}, ["Good.", "Late."]
        (tmp_path / "report.json").write_text(json.dumps({"conclusion": sentences, "frames": frames}))
        said = summarize(tmp_path)
        assert said.startswith("\nGood.\nLate.\nframes     3 captured, 3 sent") and expected in said
