"""The guided calibration, with the real detector on rendered pictures, and through the command."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pytest

from camera_node.cli import main
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, read_hand_eye
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.files import read_pairs
from camera_node.robot.calibration.hand_eye.calibrate import angle_deg, calibrate, distance_mm
from camera_node.robot.calibration.hand_eye.session import HandEyeSession, preview
from camera_node.robot.calibration.targets import parse_target
from tests.camera_node.robot.calibration import known_truth as simulated
from tests.camera_node.robot.calibration.pictures import BOARD, LENS, taken, write_poses, write_scenario

X = simulated.CAMERA_IN_HAND


def test_it_waits_for_stillness_keeps_what_is_new_and_says_when_there_is_enough():
    pictures, hands = taken()
    hands = simulated.add_noise(hands, np.random.default_rng(0), 1e-4, 2e-4)
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, want_mm=0.5)
    steps = []
    for picture, hand in zip(pictures, hands):
        assert session.offer(picture, LENS, hand).outcome == "hand moving"
        steps.append(session.offer(picture, LENS, hand))
        assert steps[-1].outcome == "kept"
        again = session.offer(picture, LENS, hand)
        assert again.outcome == f"like pose {len(steps)}" and again.count == len(steps)
    assert [s.count for s in steps] == list(range(1, 13))
    assert steps[0].std_mm is None and "turn the flange by 20" in steps[0].advice and not steps[0].enough
    assert steps[-1].enough and steps[-1].std_mm < 0.5 and "enough" in steps[-1].line
    found = calibrate(session.samples())
    assert distance_mm(found.transform, X) < 3 * steps[-1].std_mm
    assert angle_deg(found.transform, X) < 0.1
    picture = preview(pictures[-1], session.corners, steps[-1])
    assert picture.shape == (LENS.height + 40, LENS.width, 3)


def test_a_picture_without_the_target_is_not_kept():
    _, hands = taken()
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True)
    step = session.offer(np.zeros((240, 320, 3), np.uint8), LENS, hands[0])
    assert (step.outcome, step.count, step.enough) == ("target not found", 0, False)
    with pytest.raises(CalibrationError, match="too few poses: 0"):
        calibrate(session.samples())


def test_an_earlier_session_is_gone_on_with():
    pictures, hands = taken()
    kept = []
    first = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True, kept=kept.append)
    for picture, hand in zip(pictures[:6], hands):
        first.offer(picture, LENS, hand)
    second = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True, before=kept[-1])
    assert second.offer(pictures[2], LENS, hands[2]).outcome == "like pose 3"
    step = second.offer(pictures[6], LENS, hands[6])
    assert (step.outcome, step.count) == ("kept", 7)
    assert distance_mm(calibrate(second.samples()).transform, X) < 1.0


@pytest.fixture
def scenario(tmp_path):
    """A recorded camera whose poses are the hand's: photos with transforms.json."""
    return write_scenario(tmp_path, LENS, *taken())


def test_live_from_the_command_line(scenario, tmp_path, capsys):
    base = ["calibrate", "hand-eye", "--live", str(scenario), "--board", BOARD, "--camera"]
    out, samples, seen = tmp_path / "hand.yaml", tmp_path / "kept.json", tmp_path / "seen.png"
    files = ["--out", str(out), "--samples", str(samples), "--preview", str(seen)]
    arguments = [*base, "eye", "--moving", *files]
    assert main([*arguments, "--json"]) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert distance_mm(np.array(found["transform"]), X) < 0.5
    assert said.err.splitlines()[-1].endswith("kept: enough") and "10 poses" in said.err
    np.testing.assert_allclose(read_hand_eye(out).transform, found["transform"], atol=1e-8)
    assert len(read_pairs(samples, EYE_IN_HAND)) == 10 and cv2.imread(str(seen)) is not None
    # Again, with what is kept: it is enough from the first new one on.
    assert main([*arguments, "--json"]) == 0
    assert "going on with its 10 samples" in capsys.readouterr().err
    assert main([*base, "other"]) == 2
    assert "has eye, got other" in capsys.readouterr().err


def test_hand_poses_from_a_file_by_time(scenario, tmp_path, capsys):
    """The same pictures, their poses from the side: one of them too far in time from any."""
    _, hands = taken()
    known = np.delete(np.arange(len(hands)), 4)
    write_poses(tmp_path / "hand.csv", known * 2_000_000, hands[known])
    arguments = [
        "--live",
        str(scenario),
        "--camera",
        "eye",
        "--board",
        BOARD,
        "--moving",
        "--json",
        "--hand",
        str(tmp_path / "hand.csv"),
        "--max-gap-ms",
        "1",
    ]
    assert main(["calibrate", "hand-eye", *arguments]) == 0
    said = capsys.readouterr()
    assert "nearest pose is 2.0 ms away" in said.err
    assert distance_mm(np.array(json.loads(said.out)["transform"]), X) < 0.5


def test_time_that_runs_out_ends_with_what_there_is(scenario, capsys):
    assert (
        main(
            [
                "calibrate",
                "hand-eye",
                "--live",
                str(scenario),
                "--board",
                BOARD,
                "--camera",
                "eye",
                "--moving",
                "--seconds",
                "0.003",
            ]
        )
        == 2
    )
    assert "too few poses: 2" in capsys.readouterr().err
