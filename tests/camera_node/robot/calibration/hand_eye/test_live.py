"""The guided calibration with an arm in a scenario: in whose axes poses are, and by whose clock."""

from __future__ import annotations

import dataclasses
import json
import subprocess
import sys
from fractions import Fraction

import cv2
import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.config import source_config
from camera_node.robot.arm.camera_poses import base_matrix, camera_poses
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.arm.viewpoint_tour import is_free
from camera_node.robot.calibration import live_camera
from camera_node.robot.calibration.hand_eye import live
from camera_node.robot.calibration.hand_eye.calibrate import angle_deg, calibrate_tracks, distance_mm
from camera_node.robot.calibration.hand_eye.samples import inverse
from camera_node.robot.calibration.hand_eye.session import HandEyeSession
from camera_node.robot.calibration.hand_eye.tracks import MIN_SECONDS, StreamRecorder
from camera_node.robot.calibration.targets import parse_target
from camera_node.robot.hand_camera import TruthClient
from camera_node.sources.base import Shot
from freshfield.clock import WallClock
from freshfield.geometry import Pose
from freshfield.scenario import load
from tests.camera_node.robot.arm.simulated import simulated_arm
from tests.camera_node.robot.calibration import known_truth as simulate
from tests.camera_node.robot.calibration.known_truth import streams
from tests.camera_node.robot.calibration.pictures import BOARD, LENS, camera_in_target, render, taken

X = simulate.CAMERA_IN_HAND


class Replay:
    """A recording: rendered pictures, ``each`` times over, with poses (N, 4, 4) as a scenario's arm gives
    them, in the world."""

    camera, fps, intrinsics = "eye", Fraction(500), LENS

    def __init__(self, poses, stamps_ns=None, each=1):
        self._pictures = [cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB) for picture in taken()[0]]
        self._poses, self._stamps_ns = poses, stamps_ns
        self.contents, self._each = each * len(poses), each

    def content(self, tick):
        return tick

    def read(self, content):
        content //= self._each
        stamp_ns = None if self._stamps_ns is None else self._stamps_ns[content]
        return Shot(self._pictures[content], Pose.from_matrix(self._poses[content]), LENS, 0, stamp_ns)

    def release(self):
        pass


def scenario(folder, camera=None):
    arm = {
        "host": "127.0.0.9",
        "simulated": True,
        "base_m": [0.4, -0.3, 0.1],
        "base_yaw_deg": 30.0,
        "cameras": {"eye": camera},
    }
    source = {"kind": "world", "scene": "tile", "codec": "png", "fps": 500, "arm": arm}
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump({"cameras": {"ids": ["eye"]}, "source": source}))
    return file


def hands_of(setup):
    """Poses of the hand in base, of which ``taken``'s pictures are."""
    return taken()[1] if setup == EYE_IN_HAND else inverse(taken()[1])


@pytest.mark.parametrize("setup", [EYE_IN_HAND, EYE_TO_HAND])
def test_what_it_saves_is_what_the_node_takes_it_for(setup, tmp_path, monkeypatch, capsys):
    """In the axes of the arm's base, wherever that stands in the world."""
    file, out = scenario(tmp_path), tmp_path / "eye.yaml"
    plan = load(str(file))
    config = source_config(plan).arm
    base = base_matrix(config)
    recording = Replay(base @ hands_of(setup), each=2)  # each place twice: the hand holds still
    monkeypatch.setattr(live_camera, "open_sources", lambda *_: {"eye": recording})
    held = ["--eye-to-hand"] if setup == EYE_TO_HAND else []
    arguments = ["--live", str(file), "--camera", "eye", "--board", BOARD, "--out", str(out)]
    assert main(["calibrate", "hand-eye", *arguments, *held, "--json"]) == 0
    found = np.array(json.loads(capsys.readouterr().out)["transform"])
    assert distance_mm(found, X) < 0.6 and angle_deg(found, X) < 0.1
    if setup == EYE_TO_HAND:
        used = dataclasses.replace(config, cameras={"eye": str(out)})
        place = camera_poses(plan, used, ["eye"])["eye"].at(0)[0].matrix()
        assert distance_mm(place, base @ X) < 0.6


@pytest.mark.parametrize(
    ("camera", "options", "message"), [("eye.yaml", [], "source.arm.cameras: set eye: null for the calibration")]
)
def test_options_that_do_not_fit_are_refused(camera, options, message, tmp_path, capsys):
    words = ["--live", str(scenario(tmp_path, camera)), "--camera", "eye", "--board", BOARD]
    assert main(["calibrate", "hand-eye", *words, *options]) == 2
    assert message in capsys.readouterr().err


def test_the_cameras_own_stamps_are_kept_with_what_was_seen():
    stamps = [10**18 + 70_000_001 * k for k in range(6)]
    hands, tracks = hands_of(EYE_IN_HAND)[:6], StreamRecorder()
    session = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True)
    step = live.guide(Replay(hands, stamps), "png", None, session, lambda tick: True, lambda *_: None, tracks=tracks)
    seen = tracks.target()
    assert seen.times_ns.tolist() == stamps
    expected = simulate.observed_targets(hands)
    assert max(distance_mm(a, b) for a, b in zip(seen.poses, expected)) < 2.0
    assert tracks.seen_s == pytest.approx(0.35, abs=1e-3) and not step.enough


def test_recorded_streams_give_the_time_offset():
    hand, target = streams(simulate.Sweep(0.15), MIN_SECONDS + 3, 0.0371, np.random.default_rng(1))
    epoch_ns = 1_790_000_000 * 10**9
    tracks = StreamRecorder()
    for stream, add in ((hand, tracks.add_hand), (target, tracks.add_target)):
        for t_ns, pose in zip(stream.times_ns, stream.poses):
            add(int(t_ns) + epoch_ns, pose)
    assert MIN_SECONDS < tracks.seen_s < MIN_SECONDS + 3.1
    found = calibrate_tracks(tracks.hand(), tracks.target(), EYE_IN_HAND)
    assert found.time_offset_s == pytest.approx(0.0371, abs=5e-4)
    assert distance_mm(found.transform, X) < 1.0


def test_it_is_not_enough_before_there_is_motion_to_tell_the_offset_from():
    pictures, hands = taken()
    session, tracks = HandEyeSession(parse_target(BOARD), EYE_IN_HAND, moving=True), StreamRecorder()
    for picture, hand in zip(pictures, hands):
        step = session.offer(picture, LENS, hand)
    assert step.enough
    waiting = tracks.with_stream_advice(step)
    assert not waiting.enough and "10 s more" in waiting.advice
    for k in range(round(MIN_SECONDS * 15) + 2):
        tracks.add_target(k * 10**9 // 15, session.seen.pose)
    assert tracks.with_stream_advice(step).enough


MOVES = """
import sys
import numpy as np
from rtde_control import RTDEControlInterface
from tests.camera_node.robot.calibration.known_truth import random_hands
from camera_node.robot.arm.kinematics import UR3E

host, at = sys.argv[1], np.array(eval(sys.argv[2]))
control, rng = RTDEControlInterface(host), np.random.default_rng(4)
while True:
    postures = UR3E.inverse(random_hands(1, rng, 30.0)[0], at)
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
        hand = UR3E.forward(self._truth.joints(t_ns))
        picture = render(parse_target(BOARD), LENS, camera_in_target(hand), 1)
        image = cv2.cvtColor(picture, cv2.COLOR_GRAY2RGB)
        return Shot(image, Pose.from_matrix(hand), LENS, 0, t_ns + self._late_ns)

    def release(self):
        self._truth.close()


def bench(folder, host, **arm):
    """A scenario whose arm stands at ``host``, in the middle of the world; its file."""
    data = yaml.safe_load(scenario(folder).read_text())
    data["source"]["arm"] |= {"host": host, "base_m": [0.0, 0.0, 0.0], "base_yaw_deg": 0.0, **arm}
    file = folder / "bench.yaml"
    file.write_text(yaml.safe_dump(data))
    return file


def looking():
    """--joints of an arm whose camera sees the board."""
    hands = simulate.random_hands(60, np.random.default_rng(9), 30.0)
    postures = (q for hand in hands for q in UR3E.inverse(hand) if not UR3E.singularities(q))
    begin = next(joints for joints in postures if is_free(UR3E, np.eye(4), joints, joints, 0.05).all())
    return begin, "--joints=" + ",".join(f"{a:.4f}" for a in np.rad2deg(begin))


@pytest.mark.slow
@pytest.mark.alone
def test_the_time_offset_is_found_on_a_moving_arm_as_on_a_bench(tmp_path, monkeypatch, capsys, host):
    """A simulated controller with the real client library, and a camera whose stamps are 60 ms late."""
    file = bench(tmp_path, host)
    monkeypatch.setattr(live_camera, "open_sources", lambda *_: {"eye": OnArm(host, 60_000_000)})
    begin, joints = looking()
    with simulated_arm(host, joints):
        moving = subprocess.Popen([sys.executable, "-c", MOVES, host, str(begin.tolist())])
        try:
            # Real clocks on a machine that may be held up for a moment: of two recordings, one is not.
            for _ in range(2):
                arguments = [
                    "--live",
                    str(file),
                    "--camera",
                    "eye",
                    "--board",
                    BOARD,
                    "--moving",
                    "--json",
                    "--seconds",
                    "60",
                ]
                assert main(["calibrate", "hand-eye", *arguments]) == 0
                found = json.loads(capsys.readouterr().out)
                if distance_mm(np.array(found["transform"]), X) < 2.0:
                    break
        finally:
            moving.kill()
            moving.wait()
    assert found["time_offset_s"] == pytest.approx(-0.060, abs=0.006)  # joint states take their time too
    assert distance_mm(np.array(found["transform"]), X) < 2.0
