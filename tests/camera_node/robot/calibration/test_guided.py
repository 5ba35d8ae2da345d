"""The guided hand-eye calibration, with the real detector on rendered images, and through the command."""

import json
from fractions import Fraction

import cv2
import msgspec
import numpy as np
import yaml

from camera_node.cli import main
from camera_node.robot.arm.camera_poses import base_matrix, camera_poses
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
from camera_node.robot.calibration import guided
from camera_node.robot.calibration.guided import HandEyeSession, missing_turn
from camera_node.robot.calibration.hand_eye.calibrate import calibrate
from camera_node.robot.calibration.hand_eye.samples import angle_deg, distance_mm
from camera_node.robot.calibration.targets import WHICH_PRINT, parse_target
from camera_node.settings import source_config
from camera_node.sources.base import Shot
from freshfield.geometry import Pinhole, Pose, se3, se3_inverse, so3_exp
from freshfield.scenario import load
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.known_truth import BOARD, LENS, taken
from tests.camera_node.robot.calibration.test_targets import printed
from tests.support import refusal

X = known_truth.CAMERA_IN_FLANGE


def test_it_waits_for_stillness_keeps_what_is_new_and_says_when_there_is_enough():
    images, flanges = taken()
    flanges = known_truth.add_noise(flanges, np.random.default_rng(0), 1e-4, 2e-4)
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND)
    steps = []
    for image, flange in zip(images, flanges):
        assert session.offer(image, LENS, flange).outcome == "arm moving"
        steps.append(session.offer(image, LENS, flange))
        assert steps[-1].outcome == "kept"
        assert session.offer(image, LENS, flange).outcome == f"like pose {len(steps)}"
    assert [len(steps), len(session.samples)] == [12, 12]
    assert not steps[0].enough and "turn the flange by 20" in steps[0].advice
    assert steps[-1].enough and steps[-1].advice == "enough"
    found = calibrate(session.samples)
    assert distance_mm(found.transform, X) < 3 * found.refined.std_mm < 1.5
    assert angle_deg(found.transform, X) < 0.1
    step = session.offer(np.ascontiguousarray(images[-1][:, ::-1]), LENS, flanges[-1])
    assert step.outcome == "target not found" and "the picture is mirrored" in step.advice
    # The axis that is missing.
    turns = [[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.3, 0.3, -0.1]]
    poses = np.array([se3(so3_exp(turn), np.zeros(3)) for turn in turns])
    assert "about its +z" in missing_turn(poses) and "about its +y" in missing_turn(poses[:2])
    assert "bring the target" in missing_turn(poses[:0])


def test_it_asks_for_all_of_a_board_whose_part_fits_two_prints():
    whole = printed(5, 8, legacy=True)
    part = whole.copy()
    part[:, 40 + 80 * 4 :] = 255
    session = HandEyeSession(parse_target("charuco:5x8:30mm:22mm"), EYE_IN_HAND)
    lens = Pinhole(480, 720, 600.0, 600.0, 240.0, 360.0)
    steps = [session.offer(image, lens, np.eye(4)) for image in (part, part, whole, part)]
    assert [step.outcome for step in steps] == ["arm moving", "target unclear", "kept", "like pose 1"]
    assert steps[1].advice == WHICH_PRINT and len(session.samples) == 1


class Recording:
    """Rendered images, each twice, with poses (N, 4, 4) as a scenario's arm gives them: it holds still."""

    camera, fps, intrinsics = "eye", Fraction(500), LENS

    def __init__(self, poses):
        self._images = [cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) for image in taken()[0]]
        self._poses, self.contents = poses, 2 * len(poses)

    def content(self, tick):
        return tick

    def read(self, content):
        if content == 1:
            raise ValueError("no pose near enough")
        return Shot(self._images[content // 2], Pose.from_matrix(self._poses[content // 2]), LENS)

    def release(self):
        pass


def bench(folder, camera=None):
    """A scenario whose arm stands somewhere in the world; its file."""
    arm = {"host": "127.0.0.9", "base_m": [0.4, -0.3, 0.1], "base_yaw_deg": 30.0, "cameras": {"eye": camera}}
    source = {"kind": "world", "scene": "tile", "codec": "png", "arm": {**arm, "simulated": True}}
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    return file


def test_what_it_saves_is_what_the_node_takes_it_for(tmp_path, monkeypatch, capsys):
    """Of a camera that stands, in the axes of the arm's base, wherever that stands in the world."""
    file, out = bench(tmp_path), tmp_path / "eye.yaml"
    plan = load(str(file))
    config = source_config(plan).arm
    base = base_matrix(config)
    recording = Recording(base @ se3_inverse(taken()[1]))
    monkeypatch.setattr(guided, "open_sources", lambda *_: {"eye": recording})
    words = ["--live", str(file), "--camera", "eye", "--board", BOARD, "--out", str(out), "--eye-to-hand", "--json"]
    assert main(["calibrate", "hand-eye", *words]) == 0
    said = capsys.readouterr()
    assert "no pose near enough" in said.err and said.err.splitlines()[-1].endswith("kept: enough")
    found = np.array(json.loads(said.out)["transform"])
    assert distance_mm(found, X) < 0.6 and angle_deg(found, X) < 0.1
    used = msgspec.structs.replace(config, cameras={"eye": str(out)})
    place = camera_poses(plan, used, ["eye"])["eye"].at(0)[0].matrix()
    assert distance_mm(place, base @ X) < 0.6


def test_a_session_that_cannot_begin_says_why(tmp_path, capsys):
    for camera, words, why in (
        ("eye.yaml", ["--camera", "eye"], "source.arm.cameras: set eye: null for the calibration"),
        (None, ["--camera", "other"], "has eye, got other"),
        (None, [], "--camera ID: say which"),
    ):
        words = ["--live", bench(tmp_path, camera), "--board", BOARD, *words]
        assert why in refusal(capsys, main, "calibrate", "hand-eye", *words)
