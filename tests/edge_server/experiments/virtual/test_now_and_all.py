"""What is shown of a carried camera, now and all so far: which frames, when, and that the images are those scored."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest
import yaml

from edge_server.experiments.virtual import now_and_all
from edge_server.experiments.virtual.simulate import main, show
from edge_server.fidelity.psnr import psnr
from edge_server.fields import Correction, View
from freshfield.geometry import Pinhole
from tests.edge_server.experiments.sets import SMALL

TINY, LENS = np.zeros((2, 2, 3), np.uint8), Pinhole.from_fov(2, 2, 60.0)


def test_newest_and_all_held_out_frames_are_scored_each_two_seconds_and_drawn(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    world = {"kind": "world", "width": 24, "height": 24, "fps": 10, "carried": ["hand"]}
    section = {
        "cameras": {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 8},
        "source": {**world, "params": {"people": 0, "supersample": 1}},
        "channel": {"preset": "ch5"},
        "edge": {"field": "ngp", "field_options": SMALL, "steps": 2},
    }
    (tmp_path / "walk.yaml").write_text(yaml.safe_dump(section))
    assert main([str(tmp_path / "walk.yaml"), "--seconds", "5", "--json", "--out", str(tmp_path / "run")]) == 0
    whole = json.loads(capsys.readouterr().out)
    found = whole["now_and_all"]
    revisited = {"captures": 3, "apart_mm": 4.5, "apart_deg": 0.17}
    said = show({**whole, "now_and_all": {**found, "revisited": revisited}})
    assert "revisited   captures 3.00, apart_mm 4.50, apart_deg 0.17" in said and "revisited" not in show(whole)
    rows = json.loads((tmp_path / "run" / "now-and-all.json").read_text())
    assert [row["t_s"] for row in rows] == [2.0, 4.0]
    assert found == pytest.approx({name: value for name, value in rows[1].items() if name != "t_s"})
    images = dict(np.load(tmp_path / "run" / "now-and-all.npz"))
    # Frames of 0, .8, ..., 4.0 s; the newest is the last of all.
    assert images["all"].shape == (6, 24, 24, 3) and np.array_equal(images["all"][-1], images["now"])
    each = [psnr(a / 255.0, b / 255.0) for a, b in zip(images["all"], images["truth_all"])]
    assert rows[1]["now_db"] == pytest.approx(each[-1], abs=0.05) and rows[1]["all_db"] == pytest.approx(
        np.mean(each), abs=0.05
    )
    assert now_and_all.main([str(tmp_path / "run"), str(tmp_path / "run"), "--out", str(tmp_path / "both")]) == 0
    drawn: list[tuple[str, list[tuple[str, np.ndarray]]]] = []
    with monkeypatch.context() as patch:
        patch.setattr("edge_server.experiments.common.drawn_images.draw_images", lambda path, rows: drawn.extend(rows))
        now_and_all.main([str(tmp_path / "run"), "--out", str(tmp_path / "alone"), "--without-truth"])
    assert [[name for name, _ in panels] for _, panels in drawn] == [["run"], ["run"]]
    one, two = json.loads((tmp_path / "both.json").read_text())["runs"]
    assert one == two and (one["run"], one["scenario"], one["steps"]) == ("run", "walk", 2)
    assert one["now_db"] == pytest.approx(rows[1]["now_db"], abs=1e-3) and [r[0] for r in one["by_seconds"]] == [
        2.0,
        4.0,
    ]
    assert (tmp_path / "both-time.png").stat().st_size > 1000 < (tmp_path / "both-pictures.png").stat().st_size


def test_captures_that_are_shown_again_tell_how_far_poses_drift():
    def refined(view: View) -> Correction:
        pose = view.camera_to_world + 1e-3 * view.generated_ns * np.eye(4, k=3)
        return Correction(pose, np.ones(3), np.zeros(3))

    def render(pose, lens) -> SimpleNamespace:  # brighter by a tenth for each millimeter
        return SimpleNamespace(color=np.full((2, 2, 3), 0.1 + 100.0 * (pose[0, 3] % 1.0), np.float32))

    shown = SimpleNamespace(correction=refined, render=render)
    watched = now_and_all.NowAndAll(MagicMock(**{"shown_now.return_value": shown}), (), 0)
    there = np.eye(4) + np.eye(4, k=3)
    watched._frames = [View("kept", TINY, pose, LENS, k) for k, pose in enumerate((np.eye(4), there, np.eye(4)))]
    expected = {"captures": 1, "apart_mm": 2.0, "apart_deg": 0.0, "first_db": 20.0, "last_db": -20 * np.log10(0.3)}
    assert watched.means()["revisited"] == pytest.approx(expected, abs=1e-3)
