"""The display on a terminal, drawn from status files as the processes write them."""

from __future__ import annotations

import json
from pathlib import Path

from rich.console import Console

from freshfield_up.display import draw
from freshfield_up.resources import ResourceUse
from freshfield_up.status import read_status

CAMERAS = tuple(f"cam{i:02d}" for i in range(13))


def write_status(out: Path) -> None:
    node = {c: {"connected": c != "cam05", "held_out": c == "cam00", "sent": 41} for c in CAMERAS}
    (out / "node-cam00+12.json").write_text(json.dumps({"phase": "streaming", "cameras": node}))
    edge = {
        "cameras": [
            {"camera": c, "held_out": c == "cam00", "age_ms": 80.0 + 300 * i, "delivered": 37, "rejected": 0}
            for i, c in enumerate(CAMERAS)
        ],
        "policy": "all",
        "updates": {"count": 9, "ms_p50": 812.0},
        "scores": {"psnr_db": 25.125, "psnr_moving_db": None},
        "last": {"aaoi_ms": 512.0},
    }
    (out / "edge.json").write_text(json.dumps(edge))
    channel = {
        "preset": "ch6-slow",
        "state": "high",
        "state_share": {"low": 0.25, "high": 0.75},
        "counts": {"forwarded": 481, "dropped_busy": 0, "superseded": 17},
        "delay_error_ms": {"p99": 0.123},
    }
    (out / "channel.json").write_text(json.dumps(channel))


def drawn(out: Path, width: int = 100) -> str:
    console = Console(width=width, record=True, file=(out / "screen").open("w"))
    console.print(draw(read_status(out, CAMERAS), "12 of 60 s", {"edge": ResourceUse(512.0, 1.5, 17)}))
    return console.export_text()


def test_the_table_shows_what_the_processes_wrote(tmp_path: Path) -> None:
    write_status(tmp_path)
    text = drawn(tmp_path, width=140)
    assert "cam00 (held out)" in text and "cam05 (no connection)" in text
    for figure in ("80", "3680", "41", "37", "9 updates", "812 ms each", "25.1", "512 ms", "1.50 cores"):
        assert figure in text
    assert "ch6-slow, state high (75% of the time), forwarded 481, superseded 17" in text
    assert "delay error p99 0.12 ms" in text


def test_there_is_a_table_before_any_process_has_written(tmp_path: Path) -> None:
    text = drawn(tmp_path)
    assert "no channel yet" in text and "no update yet" in text
    assert all(c in text for c in CAMERAS)


def test_damaged_status_files_leave_gaps(tmp_path: Path) -> None:
    write_status(tmp_path)
    (tmp_path / "channel.json").write_text("[1, 2")
    (tmp_path / "edge.json").write_text(json.dumps({"cameras": "none", "updates": {"count": "many"}}))
    assert "no channel yet" in drawn(tmp_path)
