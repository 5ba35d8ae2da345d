"""A lens from a guided session: what it says, what it keeps, when it has enough."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.lens.session import GOOD_COVERED, GOOD_F, GOOD_PICTURES, LensSession
from camera_node.robot.calibration.targets import parse_target
from camera_node.sources.rig_calibration import load_calibration
from freshfield.clock import WallClock
from freshfield.geometry import Pinhole, so3_exp
from tests.camera_node.robot.calibration.pictures import BOARD, render, write_scenario
from tests.camera_node.sources.devices.mjpeg import NetworkCamera

LENS = Pinhole.from_fov(640, 480, 65.0)
EVERYWHERE = [(x, y) for y in (-0.45, 0.0, 0.45) for x in (-0.5, 0.0, 0.5)] * 2


@pytest.fixture(scope="module")
def board():
    """(pictures, cameras in target): a board that is held into every part of the picture, tilted."""
    target, rng = parse_target(BOARD), np.random.default_rng(8)
    middle = np.array([*np.array(target.size_m) / 2, 0.0])
    pictures, poses = [], []
    for k, (x, y) in enumerate(EVERYWHERE):
        tilt = np.deg2rad(35.0) * np.array([np.cos(2.4 * k), np.sin(2.4 * k), 0.0])
        turn = so3_exp(tilt) @ so3_exp([0.0, 0.0, rng.uniform(-0.4, 0.4)])
        seen = np.eye(4)
        seen[:3, :3] = turn
        seen[:3, 3] = rng.uniform(0.24, 0.30) * np.array([0.6 * x, 0.6 * y, 1.0]) - turn @ middle
        poses.append(np.linalg.inv(seen))
        pictures.append(render(target, LENS, poses[-1], 1))
    return pictures, poses


def test_it_asks_for_what_is_missing_until_the_lens_is_known(board):
    session = LensSession(parse_target(BOARD), moving=True)
    steps = []
    for picture in board[0]:
        steps.append(session.offer(picture))
        if steps[-1].enough:
            break
    last = steps[-1]
    assert last.enough and last.advice == "enough" and last.count >= GOOD_PICTURES
    assert last.covered >= GOOD_COVERED and last.lens.std[0] <= GOOD_F * last.lens.pinhole.fx
    assert abs(session.lens().pinhole.fx - LENS.fx) < 4 * last.lens.std[0]
    # The first pictures leave out the lower parts, and it says so.
    assert steps[2].advice.startswith("show it at the ") and "top" not in steps[2].advice
    covered = [step.covered for step in steps]
    assert covered == sorted(covered) and covered[0] < 0.5
    seen = session.preview(board[0][0], last)
    assert seen.shape == (480 + 40, 640, 3)
    assert f"{last.count} pictures" in last.line and "% of the picture covered" in last.line


def test_what_moves_and_what_was_shown_before_is_not_kept(board):
    session, pictures = LensSession(parse_target(BOARD)), board[0]
    outcomes = [session.offer(pictures[k]).outcome for k in (0, 0, 0, 4, 4)]
    assert outcomes == ["moving", "kept", "like picture 1", "moving", "kept"]
    assert session.offer(np.zeros_like(pictures[0])).outcome == "target not found"
    assert session.offer(pictures[8]).outcome == "moving", "what was not found did not hold still"
    with pytest.raises(CalibrationError, match="a picture is 100 x 50, those before were 640 x 480"):
        session.offer(np.zeros((50, 100), np.uint8))
    with pytest.raises(CalibrationError, match="too few pictures"):
        session.lens()


def test_live_from_the_command_line(board, tmp_path, capsys):
    file, out, seen = write_scenario(tmp_path, LENS, *board), tmp_path / "lens.json", tmp_path / "seen.png"
    words = ["calibrate", "intrinsics", "--board", BOARD, "--camera", "eye"]
    live = ["--live", str(file), "--moving", "--preview", str(seen), "--out", str(out)]
    assert main([*words, *live]) == 0
    said = capsys.readouterr()
    assert "kept: show it at the " in said.err and said.err.splitlines()[-1].endswith("kept: enough")
    assert "reprojection" in said.out and cv2.imread(str(seen)) is not None
    found = load_calibration(out)["eye"].intrinsics
    assert abs(found.fx / LENS.fx - 1) < 0.01 and abs(found.cx - LENS.cx) < 3.0
    assert main([*words, "--live", str(file), str(tmp_path)]) == 2
    assert "expected one of FOLDER, --live SCENARIO" in capsys.readouterr().err
    assert main([*words, str(tmp_path), "--seconds", "3"]) == 2
    assert "--seconds: goes with --live" in capsys.readouterr().err


def test_a_camera_without_a_lens_is_what_it_is_for(tmp_path, capsys):
    """Its source would ask for the calibration that is to be made."""
    camera = NetworkCamera(WallClock())
    file = tmp_path / "bench.yaml"
    source = {"kind": "camera", "devices": {"eye": camera.address}, "first_frame_s": 10, "fps": 15}
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    words = ["calibrate", "intrinsics", "--board", BOARD, "--camera", "eye", "--live", str(file)]
    assert main([*words, "--seconds", "0.5"]) == 2
    camera.close()
    assert "too few pictures show the target" in capsys.readouterr().err
    assert main(words) == 2
    assert "eye: no camera at http" in capsys.readouterr().err
