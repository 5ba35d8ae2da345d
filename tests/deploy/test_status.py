"""The line that the launcher prints, from status files as the processes write them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from freshfield_up.status import status_line
from freshfield_up.summary import summarize

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


def test_the_line_says_what_the_processes_wrote(tmp_path: Path) -> None:
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


def test_missing_and_damaged_status_files_leave_gaps(tmp_path: Path) -> None:
    assert status_line(tmp_path, 13) == "0/13 cameras; no update yet; no channel yet"
    (tmp_path / "channel.json").write_text("[1, 2")
    (tmp_path / "edge.json").write_text(json.dumps({"cameras": "none", "updates": {"count": "many"}}))
    assert status_line(tmp_path, 13) == "0/13 cameras; no update yet; no channel yet"


@pytest.mark.parametrize(
    "found, expected",
    [
        ({"closes": True, "cut_off": 2}, "; all accounted for, 2 of them cut off by the end of a process\n"),
        (
            {"closes": False, "doubts": ["2,014 lines of the ledgers were lost", "another"]},
            "; NOT ALL ACCOUNTED FOR: 2,014 lines of the ledgers were lost; another\n",
        ),
    ],
)
def test_the_summary_is_the_conclusion_and_whether_all_frames_are_accounted_for(tmp_path, found, expected):
    frames, sentences = {"captured": 3, "sent": 3, "delivered": 3, "rejected": {}, **found}, ["Good.", "Late."]
    (tmp_path / "report.json").write_text(json.dumps({"conclusion": sentences, "frames": frames}))
    said = summarize(tmp_path)
    assert said.startswith("\nGood.\nLate.\nframes     3 captured, 3 sent") and expected in said
