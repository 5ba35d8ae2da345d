"""A world camera in the hand of a simulated arm."""

import contextlib
import dataclasses
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from camera_node.capture import build_cameras
from camera_node.pose.providers import PoseGapError
from camera_node.robot.arm import ArmError
from camera_node.robot.arm.camera_poses import base_matrix, load_hand_eyes
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.flange_camera import TruthClient
from camera_node.settings import source_config
from camera_node.synthetic.depth import DepthRenderer
from freshfield import payload
from freshfield.clock import WallClock
from freshfield.scenario import Scenario, load
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde, simulated_arm
from tests.support import refused, wait_until

CELL = load("cell")
LOOKING = (-95.90, 9.29, -109.38, 0.72, 262.47, 38.48)  # degrees, from a viewpoint of the cell's tour


def at(host: str, **source: object) -> Scenario:
    arm = {**CELL.source["arm"], "host": host, "max_gap_ms": 2000.0}
    changed = {"width": 48, "height": 48, "params": {"supersample": 1}, "codec": "png", **source}
    return dataclasses.replace(CELL, source={**CELL.source, "arm": arm, **changed})


def take(camera):
    """One frame of now, or none yet on a busy machine."""
    with contextlib.suppress(PoseGapError):
        return camera.capture(int(time.time() * camera.fps))


def test_what_it_sees_and_what_it_claims_agree_where_the_arm_stands(host):
    scenario = at(host, effects={"depth_sensor": {"nearest_m": 0.1}}, depth_every=1)
    with simulated_arm(host, f"--joints={','.join(map(str, LOOKING))}"):
        fixed, hand = build_cameras(scenario, source_config(scenario), scenario.cameras)
        assert hand.waits and not fixed.waits
        shot = wait_until(lambda: take(hand), "no frame", 2.0)
        config = source_config(scenario).arm
        mount = load_hand_eyes(scenario, config, ["hand"])["hand"].transform
        place = base_matrix(config) @ UR3E.forward(np.deg2rad(LOOKING)) @ mount
        assert np.allclose(shot.pose.matrix(), place, atol=1e-12)
        scene = fixed.source.scene
        expected = scene.view(shot.intrinsics, place).image(0.0)
        assert np.array_equal(payload.decode(shot.payload, "png", 48, 48), expected)
        exact = DepthRenderer(scene.world, shot.intrinsics, place).depth(0.0)
        measured = shot.encoded_depth.decode().meters()
        seen = (measured > 0) & (exact > 0)
        assert seen.sum() > 0.6 * (exact > 0).sum() and np.median(np.abs(measured - exact)[seen] / exact[seen]) < 0.02
        assert shot.intrinsics == fixed.source.intrinsics
        hand.source._carrier.poses._flange._stream.stop()


def test_the_truth_of_another_instant_is_not_taken(host):
    with simulated_arm(host):
        truth, clock = TruthClient(host), WallClock()
        assert truth.joints(clock.now_ns()).shape == (6,)
        for offset_ns in (-3600 * 10**9, 10**9):
            refused(PoseGapError, "ms away: is this machine too busy", truth.joints, clock.now_ns() + offset_ns)
        # Each camera on the arm asks from a thread of its own, and gets its own instant's answer.
        time.sleep(0.5)
        instants = [clock.now_ns() - k * 10_000_000 for k in range(40)]
        with ThreadPoolExecutor(4) as threads:
            assert len(list(threads.map(truth.joints, 5 * instants))) == 200


def test_without_an_arm_one_line_says_what_to_start():
    require_ur_rtde()
    scenario, begin = at(own_address()), time.monotonic()
    with pytest.raises(ArmError, match=r"no answer on port 30004 \(Connection refused\).*camera-node simulate-arm"):
        build_cameras(scenario, source_config(scenario), scenario.cameras)
    assert time.monotonic() - begin < 3.0


def test_fixed_cameras_of_the_scenario_need_no_arm():
    scenario = at(own_address())
    (camera,) = build_cameras(scenario, source_config(scenario), ["cam00"])
    assert len(camera.capture(0).payload) > 100
