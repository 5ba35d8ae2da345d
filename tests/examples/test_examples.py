"""The examples run as a reader would run them, on small data."""

import json
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest

from tests.conftest import ROOT
from tests.deploy.test_up import SMALL
from tests.edge_server.experiments.sets import write_photos
from tests.support import free_port

ONE_CAMERA = """
name: mine
description: one camera that somebody else's program streams
seed: 1
cameras: {ids: [cam01]}
source: {kind: world, scene: room, width: 64, height: 48}
edge: {field: ngp, lpips: none}
"""
pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def start(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> Callable[..., str]:
    """Runs an example with words, and gives what it prints."""
    monkeypatch.setenv("MPLBACKEND", "agg")

    def run(name: str, *words: object) -> str:
        monkeypatch.setattr(sys, "argv", [name, *map(str, words)])
        runpy.run_path(str(ROOT / "examples" / name), run_name="__main__")
        return capfd.readouterr().out

    return run


def test_own_data_become_splats_and_a_video(start, tmp_path: Path) -> None:
    write_photos(tmp_path / "set", 9)
    said = start("own_data.py", tmp_path / "set", tmp_path / "set.ply", 1)
    assert "set: 7 views of 32 x 32" in said and "dB" in said
    assert (tmp_path / "set.ply").read_bytes().startswith(b"ply\n")
    start("novel_views.py", tmp_path / "set.ply-fit", tmp_path / "orbit.mp4", 3)
    video = cv2.VideoCapture(str(tmp_path / "orbit.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == 3 and video.get(cv2.CAP_PROP_FRAME_WIDTH) == 320


def test_ages_are_plotted(start, tmp_path: Path) -> None:
    assert "mean age" in start("channel_ages.py", tmp_path / "ages.png")
    assert cv2.imread(str(tmp_path / "ages.png")) is not None


def test_a_policy_of_ones_own_is_tried(start, tmp_path: Path) -> None:
    quick = "field: splat, field_options: {gaussians: 128, start: 96, seed_cells: 8}"
    (tmp_path / "small.yaml").write_text(SMALL.replace("field: ngp", quick))
    lines = start("own_policy.py", tmp_path / "small.yaml", 2).splitlines()
    assert [line.split(":")[0] for line in lines] == ["all", "youngest-half"]


@pytest.mark.slow
def test_a_deployment_runs_from_a_script(start, tmp_path: Path) -> None:
    (tmp_path / "small.yaml").write_text(SMALL)
    said = start("deployment.py", tmp_path / "small.yaml", 6, tmp_path / "run")
    assert "all frames accounted for: True" in said and "http://127.0.0.1:" in said


@pytest.mark.slow
def test_arrays_of_ones_own_reach_an_edge(start, tmp_path: Path) -> None:
    scenario, edge = tmp_path / "mine.yaml", f"127.0.0.1:{free_port()}"
    scenario.write_text(ONE_CAMERA)
    words = ["-m", "edge_server.cli", "run", str(scenario), "--listen", edge, "--out", str(tmp_path / "edge")]
    server = subprocess.Popen([sys.executable, *words], stderr=subprocess.DEVNULL)
    try:
        assert int(start("numpy_camera.py", scenario, edge, 20).split()[0]) > 10
    finally:
        server.terminate()
        server.wait(60)
    status = json.loads((tmp_path / "edge" / "edge.json").read_text())
    assert [camera["camera"] for camera in status["cameras"]] == ["cam01"]
