"""The guided calibration, with the real detector on rendered images, and through the command."""

from __future__ import annotations

import json
import subprocess
import sys
from fractions import Fraction

import cv2
import msgspec
import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.config import source_config
from camera_node.robot.arm.camera_poses import base_matrix, camera_poses
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND, read_hand_eye
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.arm.viewpoint_tour import is_free
from camera_node.robot.calibration import guided
from camera_node.robot.calibration.guided import draw_step
from camera_node.robot.calibration.hand_eye.calibrate import calibrate, calibrate_tracks
from camera_node.robot.calibration.hand_eye.samples import angle_deg, distance_mm
from camera_node.robot.calibration.hand_eye.session import (
    MIN_SECONDS,
    HandEyeSession,
    StreamRecorder,
    missing_turn,
    session_steps,
)
from camera_node.robot.calibration.inputs import read_pairs
from camera_node.robot.calibration.targets import parse_target
from camera_node.robot.flange_camera import TruthClient
from camera_node.sources.base import Shot
from freshfield.clock import WallClock
from freshfield.geometry import Pose, se3, se3_inverse, so3_exp
from freshfield.scenario import load
from tests.camera_node.robot.arm.simulated import simulated_arm
from tests.camera_node.robot.calibration import known_truth
from tests.camera_node.robot.calibration.rendered import BOARD, LENS, camera_in_target, render, taken, write_scenario

X = known_truth.CAMERA_IN_FLANGE


def test_it_waits_for_stillness_keeps_what_is_new_and_says_when_there_is_enough():
    images, flanges = taken()
    flanges = known_truth.add_noise(flanges, np.random.default_rng(0), 1e-4, 2e-4)
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, want_mm=0.5)
    steps = []
    for image, flange in zip(images, flanges):
        assert session.offer(image, LENS, flange).outcome == "arm moving"
        steps.append(session.offer(image, LENS, flange))
        assert steps[-1].outcome == "kept"
        assert session.offer(image, LENS, flange).outcome == f"like pose {len(steps)}"
    assert [len(steps), len(session.samples)] == [12, 12]
    assert not steps[0].enough and "turn the flange by 20" in steps[0].advice
    assert steps[-1].enough and session.refined.std_mm < 0.5 and "enough" in steps[-1].line
    found = calibrate(session.samples)
    assert distance_mm(found.transform, X) < 3 * session.refined.std_mm
    assert angle_deg(found.transform, X) < 0.1
    assert draw_step(images[-1], session.corners, steps[-1]).shape == (LENS.height + 40, LENS.width, 3)
    step = session.offer(np.zeros((240, 320, 3), np.uint8), LENS, flanges[-1])
    assert step.outcome == "target not found"


def test_it_asks_for_turns_about_the_axis_that_is_missing():
    turns = [[0, 0, 0], [0.4, 0, 0], [0, 0.3, 0], [0.3, 0.3, -0.1]]
    poses = np.array([se3(so3_exp(turn), np.zeros(3)) for turn in turns])
    assert "about its +z" in missing_turn(poses) and "about its +y" in missing_turn(poses[:2])
    assert "bring the target" in missing_turn(poses[:0])


def test_an_earlier_session_is_gone_on_with():
    images, flanges = taken()
    kept = []
    first = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True, kept=kept.append)
    for image, flange in zip(images[:6], flanges):
        first.offer(image, LENS, flange)
    second = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True, before=kept[-1])
    assert second.offer(images[2], LENS, flanges[2]).outcome == "like pose 3"
    assert second.offer(images[6], LENS, flanges[6]).outcome == "kept" and len(second.samples) == 7
    assert distance_mm(calibrate(second.samples).transform, X) < 1.0


@pytest.fixture
def recorded(tmp_path):
    """A recorded camera whose poses are the flange's: photos with transforms.json."""
    return write_scenario(tmp_path, LENS, *taken())


def test_live_from_the_command_line(recorded, tmp_path, capsys):
    base = ["calibrate", "hand-eye", "--live", str(recorded), "--board", BOARD, "--moving", "--json", "--camera"]
    out, samples, seen = tmp_path / "hand.yaml", tmp_path / "kept.json", tmp_path / "seen.png"
    files = ["--out", str(out), "--samples", str(samples), "--preview", str(seen)]
    assert main([*base, "eye", *files]) == 0
    said = capsys.readouterr()
    found = json.loads(said.out)
    assert distance_mm(np.array(found["transform"]), X) < 0.5
    assert said.err.splitlines()[-1].endswith("kept: enough") and "10 poses" in said.err
    np.testing.assert_allclose(read_hand_eye(out).transform, found["transform"], atol=1e-8)
    assert len(read_pairs(samples, EYE_IN_HAND)) == 10 and cv2.imread(str(seen)) is not None
    assert main([*base, "eye", "--seconds", "0.003"]) == 2
    assert "too few poses: 2" in capsys.readouterr().err
    assert main([*base, "other"]) == 2
    assert "has eye, got other" in capsys.readouterr().err


class Replay:
    """A recording: rendered images, ``each`` times over, with poses (N, 4, 4) as a scenario's arm gives them."""

    camera, fps, intrinsics = "eye", Fraction(500), LENS

    def __init__(self, poses, stamps_ns=None, each=1):
        self._images = [cv2.cvtColor(image, cv2.COLOR_GRAY2RGB) for image in taken()[0]]
        self._poses, self._stamps_ns = poses, stamps_ns
        self.contents, self._each = each * len(poses), each

    def content(self, tick):
        return tick

    def read(self, content):
        content //= self._each
        stamp_ns = None if self._stamps_ns is None else self._stamps_ns[content]
        return Shot(self._images[content], Pose.from_matrix(self._poses[content]), LENS, 0, stamp_ns)

    def release(self):
        pass


def bench(folder, host="127.0.0.9", camera=None, **arm):
    """A scenario whose arm stands somewhere in the world; its file."""
    arm = {
        "host": host,
        "simulated": True,
        "base_m": [0.4, -0.3, 0.1],
        "base_yaw_deg": 30.0,
        "cameras": {"eye": camera},
        **arm,
    }
    source = {"kind": "world", "scene": "tile", "codec": "png", "fps": 500, "arm": arm}
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    return file


@pytest.mark.parametrize("setup", [EYE_IN_HAND, EYE_TO_HAND])
def test_what_it_saves_is_what_the_node_takes_it_for(setup, tmp_path, monkeypatch, capsys):
    """In the axes of the arm's base, wherever that stands in the world."""
    file, out = bench(tmp_path), tmp_path / "eye.yaml"
    plan = load(str(file))
    config = source_config(plan).arm
    base = base_matrix(config)
    flanges = taken()[1] if setup == EYE_IN_HAND else se3_inverse(taken()[1])
    recording = Replay(base @ flanges, each=2)  # each place twice: the arm holds still
    monkeypatch.setattr(guided, "open_sources", lambda *_: {"eye": recording})
    held = ["--eye-to-hand"] if setup == EYE_TO_HAND else []
    arguments = ["--live", str(file), "--camera", "eye", "--board", BOARD, "--out", str(out)]
    assert main(["calibrate", "hand-eye", *arguments, *held, "--json"]) == 0
    found = np.array(json.loads(capsys.readouterr().out)["transform"])
    assert distance_mm(found, X) < 0.6 and angle_deg(found, X) < 0.1
    if setup == EYE_TO_HAND:
        used = msgspec.structs.replace(config, cameras={"eye": str(out)})
        place = camera_poses(plan, used, ["eye"])["eye"].at(0)[0].matrix()
        assert distance_mm(place, base @ X) < 0.6


def test_a_camera_that_is_calibrated_already_is_refused(tmp_path, capsys):
    words = ["--live", str(bench(tmp_path, camera="eye.yaml")), "--camera", "eye", "--board", BOARD]
    assert main(["calibrate", "hand-eye", *words]) == 2
    assert "source.arm.cameras: set eye: null for the calibration" in capsys.readouterr().err


def test_streams_keep_the_cameras_stamps_and_end_when_there_is_motion_enough():
    stamps = [10**18 + 70_000_001 * k for k in range(12)]
    flanges, streams = taken()[1], StreamRecorder()
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True)
    config = source_config(load("tile"))
    steps = session_steps(
        session,
        Replay(flanges, stamps),
        msgspec.structs.replace(config, codec="png"),
        lambda tick: True,
        streams=streams,
    )
    *_, (_, _, last) = steps
    seen = streams.target()
    assert seen.times_ns.tolist() == stamps and streams.seen_s == pytest.approx(0.77, abs=1e-3)
    assert distance_mm(seen.poses, known_truth.observed_targets(flanges)).max() < 2.0
    assert session.varied and not last.enough and "9 s more" in last.advice
    for k in range(round(MIN_SECONDS * 15) + 2):
        streams.add_target(stamps[-1] + k * 10**9 // 15, session.target_pose)
    assert streams.advise(last, session).enough


def test_recorded_streams_give_the_time_offset():
    flange, target = known_truth.streams(known_truth.Sweep(0.15), 13.0, 0.0371, np.random.default_rng(1))
    streams, epoch_ns = StreamRecorder(), 1_790_000_000 * 10**9
    for track, add in ((flange, streams.add_flange), (target, streams.add_target)):
        for t_ns, pose in zip(track.times_ns, track.poses):
            add(int(t_ns) + epoch_ns, pose)
    found = calibrate_tracks(streams.flange(), streams.target(), EYE_IN_HAND)
    assert found.time_offset_s == pytest.approx(0.0371, abs=5e-4)
    assert distance_mm(found.transform, X) < 1.0


MOVES = """
import sys
import numpy as np
from rtde_control import RTDEControlInterface
from tests.camera_node.robot.calibration.known_truth import random_flanges
from camera_node.robot.arm.kinematics import UR3E

host, at = sys.argv[1], np.array(eval(sys.argv[2]))
control, rng = RTDEControlInterface(host), np.random.default_rng(4)
while True:
    postures = UR3E.inverse(random_flanges(1, rng, 30.0)[0], at)
    if postures and np.abs(postures[0] - at).max() < 1.5:
        at = postures[0]
        control.moveJ(at.tolist(), rng.uniform(0.3, 0.9), rng.uniform(1.0, 3.0))
"""


class OnArm:
    """What a camera on a simulated arm sees of the board, stamped ``late_ns`` after it saw it."""

    camera, fps, contents, intrinsics = "eye", Fraction(15), None, LENS

    def __init__(self, host, late_ns):
        self._truth, self._late_ns, self._clock = TruthClient(host), late_ns, WallClock()

    def content(self, tick):
        return tick

    def read(self, content):
        t_ns = self._clock.now_ns()
        flange = UR3E.forward(self._truth.joints(t_ns))
        image = cv2.cvtColor(render(parse_target(BOARD), LENS, camera_in_target(flange), 1), cv2.COLOR_GRAY2RGB)
        return Shot(image, Pose.from_matrix(flange), LENS, 0, t_ns + self._late_ns)

    def release(self):
        self._truth.close()


@pytest.mark.slow
@pytest.mark.alone
def test_the_time_offset_is_found_on_a_moving_arm_as_on_a_bench(tmp_path, monkeypatch, capsys, host):
    """A simulated controller with the real client library, and a camera whose stamps are 60 ms late."""
    file = bench(tmp_path, host, base_m=[0.0, 0.0, 0.0], base_yaw_deg=0.0)
    monkeypatch.setattr(guided, "open_sources", lambda *_: {"eye": OnArm(host, 60_000_000)})
    flanges = known_truth.random_flanges(60, np.random.default_rng(9), 30.0)
    postures = (q for flange in flanges for q in UR3E.inverse(flange) if not UR3E.singularities(q))
    begin = next(joints for joints in postures if is_free(UR3E, np.eye(4), joints, joints, 0.05).all())
    arguments = ["--live", str(file), "--camera", "eye", "--board", BOARD, "--moving", "--json", "--seconds", "60"]
    with simulated_arm(host, "--joints=" + ",".join(f"{a:.4f}" for a in np.rad2deg(begin))):
        moving = subprocess.Popen([sys.executable, "-c", MOVES, host, str(begin.tolist())])
        try:
            # Real clocks on a machine that may be held up for a moment: of two recordings, one is not.
            for _ in range(2):
                assert main(["calibrate", "hand-eye", *arguments]) == 0
                found = json.loads(capsys.readouterr().out)
                if distance_mm(np.array(found["transform"]), X) < 2.0:
                    break
        finally:
            moving.kill()
            moving.wait()
    assert found["time_offset_s"] == pytest.approx(-0.060, abs=0.006)  # joint states take their time too
    assert distance_mm(np.array(found["transform"]), X) < 2.0
