"""Scores of a carried camera in virtual time, now and all so far: of which frames, when, and that reports draw them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from edge_server.experiments.virtual.simulate import main
from edge_server.report.build_report import build_report
from tests.edge_server.experiments.sets import SMALL


def test_newest_and_all_held_out_frames_are_scored_each_two_seconds_and_reported(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    world = {"kind": "world", "width": 24, "height": 24, "fps": 10, "carried": ["hand"]}
    section = {
        "cameras": {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 8},
        "source": {**world, "params": {"people": 0, "supersample": 1}},
        "channel": {"preset": "ch5"},
        "edge": {"field": "ngp", "field_options": SMALL, "steps": 2},
    }
    (tmp_path / "walk.yaml").write_text(yaml.safe_dump(section))
    run = tmp_path / "run"
    assert main([str(tmp_path / "walk.yaml"), "--seconds", "5", "--json", "--out", str(run)]) == 0
    means = json.loads(capsys.readouterr().out)["now_and_all"]
    last = json.loads((run / "edge.json").read_text())["so_far"]
    # Frames of 0, .8, ..., 4.0 s; marks at 2 and 4 s, and means are those from 4 s on.
    assert last["frames"] == 6 and last["now_psnr_db"] != last["all_psnr_db"]
    assert means == pytest.approx({name: last[name] for name in means}) and "all_ssim" in means
    shown = [json.loads(line) for line in (run / "shown.jsonl").read_text().splitlines()]
    assert [row.get("so_far") is not None for row in shown] == [row["t_s"] >= 2.0 for row in shown]
    assert shown[-1]["so_far"] == last and build_report(run)["fidelity"]["so_far"] == last
