"""``bench options``: every optional part off and on, and nothing measured twice."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.experiments.bench import options as bench_options
from edge_server.experiments.bench.option_ablation import (
    MOVING,
    OPTIONS,
    SCENES,
    Option,
    Scene,
    displaced,
    missing,
    with_gains,
)
from edge_server.experiments.bench.options import Workload, label
from edge_server.experiments.scenes.multiview_sequence import synthetic_sequence
from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields.registry import field_names, make_field

TINY = Workload(1, 3, (0.1,), 2, 2, (0.1,), 4)
TRIED = (
    Option("color", {"harmonics": 1}, {"harmonics": 4}, ("still",)),
    Option("distortion", {"distortion": 0.0}, {"distortion": 0.01}, ("still",)),
    Option("sharpness", {"sharpness": 0.0}, {"sharpness": 1.0}, ("still",)),
    Option("changed", {"changed_share": 0.0}, {"changed_share": 0.25}, ("room, late",)),
)


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch) -> None:
    sequence = partial(synthetic_sequence, "room", 5, 24, speed_m_per_s=1.0)
    scenes = {
        "still": ("small", lambda: Scene(synthetic_still("tile", 5, 24))),
        "room, late": ("small, too", lambda: Scene(sequence=sequence(), late=2)),
    }
    monkeypatch.setattr(bench_options, "OPTIONS", TRIED)
    monkeypatch.setattr(bench_options, "SCENES", scenes)
    monkeypatch.setattr(bench_options, "QUICK", TINY)


def bench(path: Path, *words: str) -> int:
    return edge_server(["bench", "options", "--quick", "--field", "ngp", "--json", str(path), *words])


def test_every_option_is_measured_off_and_on(tmp_path, tiny, capsys):
    path = tmp_path / "bench.json"
    assert bench(path) == 0
    out = capsys.readouterr().out
    found = json.loads(path.read_text())["options"]
    # Three settings on one scene serve two options: at its default everything is measured once.
    assert sorted(found["points"]["still"]["ngp"]) == ["default", "distortion=0.0", "harmonics=4"]
    assert "ngp has no option sharpness" in found["left_out"]["ngp"]["sharpness"]
    rows = {row["option"]: row for row in found["rows"]}
    assert list(rows) == ["color", "distortion", "changed"]
    assert rows["color"]["off"] == rows["distortion"]["on"]
    for row in rows.values():
        steps = "2_steps" if row["scene"] in MOVING else "3_steps"
        assert row["off"]["steps"][steps] == (4 if row["scene"] in MOVING else 3)  # of two updates, or once
        for run in (steps, "0.1_s"):
            gain = row["on"]["psnr_db"][run] - row["off"]["psnr_db"][run]
            assert row["gain_psnr_db"][run] == gain and 5.0 < row["on"]["psnr_db"][run] < 40.0
        assert row["ms_per_step_times"] == row["on"]["ms_per_step"] / row["off"]["ms_per_step"] > 0.0
        assert row["on"]["cpu_ms_per_step"] > 0.0
    assert rows["changed"]["gain_psnr_moving_db"]["2_steps"] is not None

    text = path.with_suffix(".md").read_text()
    for row in rows.values():
        line = next(t for t in text.splitlines() if t.startswith(f"| {row['option']} | {row['scene']} | ngp |"))
        for run, gain in row["gain_psnr_db"].items():
            shown = f"{row['off']['psnr_db'][run]:.2f}, {row['on']['psnr_db'][run]:.2f}, **{gain:+.2f}**"
            assert shown in line
        assert f"{row['off']['ms_per_step']:.2f}, {row['on']['ms_per_step']:.2f} |" in line
        assert line in out
    assert "sharpness: left out" in text


def test_what_is_known_is_not_measured_again(tmp_path, tiny, monkeypatch):
    path, asked = tmp_path / "bench.json", []
    point = bench_options._point

    def counted(name, make, scene, options, workload):
        asked.append((scene, dict(options)))
        if len(asked) == 3:
            raise KeyboardInterrupt
        return point(name, make, scene, options, workload)

    monkeypatch.setattr(bench_options, "_point", counted)
    assert bench(path, "--only", "color", "--only", "distortion") == 130
    before = json.loads(path.read_text())["options"]
    assert [row["option"] for row in before["rows"]] == ["color"]  # of the other only one side is known
    assert "| color | still |" in path.with_suffix(".md").read_text()
    assert bench(path, "--resume") == 0
    assert len(asked) == 3 + 3  # what was interrupted, and two of the moving scene
    after = json.loads(path.read_text())["options"]
    assert after["rows"][0] == before["rows"][0] and len(after["rows"]) == 3
    # Other budgets are other figures.
    monkeypatch.setattr(bench_options, "QUICK", replace(TINY, steps=4))
    assert bench(path, "--resume", "--only", "color") == 0
    assert len(asked) == 6 + 2
    # What was measured with the old ones is not set beside them.
    mixed = json.loads(path.read_text())["options"]["rows"]
    assert [row["option"] for row in mixed] == ["color", "changed"]


def test_an_option_that_does_not_exist_is_refused(tmp_path, tiny, capsys):
    assert bench(tmp_path / "bench.json", "--only", "taste") == 1
    assert "no option is called taste: color, distortion" in capsys.readouterr().err


def test_every_option_is_one_of_some_representation_and_has_scenes():
    for option in OPTIONS:
        assert option.scenes and set(option.scenes) <= set(SCENES)
        assert set(option.off) == set(option.on)
        having = []
        for name in field_names():
            try:
                make_field(name, option.on), make_field(name, option.off)
                having.append(name)
            except ValueError:
                continue
            assert label(name, option.on) != label(name, option.off)
        assert having, f"no representation has {option.name}"
    assert set(MOVING) <= set(SCENES)


def test_scenes_without_their_data_are_left_out(monkeypatch, tmp_path, capsys):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    assert missing(SCENES) == {"lego", "kitchen", "kitchen, moving", "kitchen, six"}
    (tmp_path / "blender_kitchen").mkdir()
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path))
    assert missing(("tile", "lego", "kitchen")) == {"lego"}
    assert "has no folder lego_synthetic" in capsys.readouterr().out


def test_gains_and_displaced_poses_are_as_large_as_said():
    views = synthetic_still("tile", 13, 16).training
    bright = with_gains(views, 0.2)
    ratio = np.array([b.image.mean((0, 1)) / v.image.mean((0, 1)) for b, v in zip(bright, views)])
    assert np.exp(np.log(ratio).mean()) == pytest.approx(1.0, abs=0.05)  # clipping takes a little
    assert 0.1 < np.log(ratio).std() < 0.3
    off = displaced(views, 0.01, 1.0)
    apart = np.array([o.camera_to_world[:3, 3] - v.camera_to_world[:3, 3] for o, v in zip(off, views)])
    turned = [o.camera_to_world[:3, :3] @ v.camera_to_world[:3, :3].T for o, v in zip(off, views)]
    angles = [np.rad2deg(np.arccos((np.trace(r) - 1.0) / 2.0)) for r in turned]
    assert np.linalg.norm(apart, axis=1).mean() == pytest.approx(0.01)
    assert np.allclose(apart.mean(axis=0), 0.0, atol=1e-12)
    assert np.mean(angles) == pytest.approx(1.0, abs=1e-3)
    assert all(o.image is v.image for o, v in zip(off, views))
