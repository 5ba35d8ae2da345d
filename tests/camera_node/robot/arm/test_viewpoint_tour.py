"""Where the arm carries its camera: the tour of viewpoints, and the saved hand-eye calibration on the arm's clock:
T_W^C = T_W^EE T_EE^C (4.7)."""

import itertools

import msgspec
import numpy as np
import pytest
import yaml

from camera_node.pose.pairing import SampleBuffer
from camera_node.robot.arm import ArmError
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.capsules import CapsuleModel
from camera_node.robot.arm.hand_eye_mount import read_hand_eye
from camera_node.robot.arm.kinematics import UR3E, apply_calibration
from camera_node.robot.arm.viewpoint_tour import FARTHEST_RAD, _extend_tour, is_free, plan_tour, reachable, viewpoints
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.settings import PathConfig, source_config
from freshfield.geometry import Pose, se3, so3_exp
from freshfield.scenario import ScenarioError, load, parse
from tests.support import refused

CELL = load("cell")
ARM = source_config(CELL).arm
BASE = base_matrix(ARM)
MOUNT = load_hand_eyes(CELL, ARM, ["hand"])["hand"].transform


def test_viewpoints_look_at_their_target_from_their_radius():
    path = PathConfig(target_m=(0.1, 0.2, 0.3), radius_m=0.5, elevations_deg=(20.0, 70.0), step_deg=30.0)
    poses = viewpoints(path)
    assert len(poses) == 14
    for pose in poses:
        to = np.array(path.target_m) - pose[:3, 3]
        assert np.isclose(np.linalg.norm(to), 0.5) and np.allclose(pose[:3, 2], to / 0.5)
    azimuths = [np.arctan2(pose[0, 3] - 0.1, 0.2 - pose[1, 3]) for pose in poses]
    heights = [pose[2, 3] for pose in poses]
    assert heights[0] > heights[1] and np.isclose(azimuths[0], azimuths[1])  # down, and beside that up again
    assert np.isclose(heights[1], heights[2]) and azimuths[1] < azimuths[2]


def test_a_calibrated_arm_is_kept_above_the_floor_too(factory):
    """The height of its joints, not of the frames that its calibration puts meters beside them."""
    arm = apply_calibration(UR3E, factory)
    shape, free = CapsuleModel(UR3E, 0.08, 0.04), 0
    for joints in np.random.default_rng(6).uniform(-3, 3, (200, 6)):
        if shape.clearance(UR3E.link_frames(joints[None]))[0].min() < 0.03:
            continue
        free += 1
        lowest_m = (BASE @ UR3E.link_frames(joints))[2:, 2, 3].min()
        for floor_m in (lowest_m - 0.006, lowest_m + 0.006):
            assert is_free(arm, BASE, joints, joints, floor_m).all() == (floor_m < lowest_m)
    assert free > 50


def test_an_arm_is_not_driven_through_itself():
    """Between two postures that are free the straight way in joint space need not be."""
    home = np.array(HOME_RAD)
    folded, other = (np.where(np.arange(6) == 2, elbow, home) for elbow in (-np.pi + 0.05, -1.5 * np.pi))
    assert is_free(UR3E, BASE, home, home, -1.0) and is_free(UR3E, BASE, other, other, -1.0)
    assert not is_free(UR3E, BASE, folded, folded, -1.0)
    assert not is_free(UR3E, BASE, home, other, -1.0)


def test_from_where_no_path_leads_on_the_tour_goes_back():
    """Two viewpoints that only the first one leads to: back between them, and no way back at the end."""
    home = np.array(HOME_RAD)
    joints = home + np.array([[0.0] * 6, [1.2, 0, 0, 0, 0, 0], [-1.3, 0, 0, 0, 0, 0]])
    tour, used = _extend_tour(UR3E, BASE, -1.0, joints, np.array([0, 1, 2]), 0)
    np.testing.assert_allclose(tour.stops, [joints[0], joints[1], joints[0], joints[2]])
    assert tour.places == [0, 1, 2] and used.all()


def test_a_tour_passes_the_viewpoints_that_a_free_posture_above_the_floor_reaches():
    path = msgspec.structs.replace(ARM.path, step_deg=80.0)
    poses = viewpoints(path)
    assert reachable(UR3E, BASE, MOUNT, path, poses).sum() >= 10
    low = [pose.copy() for pose in poses[:3]]
    for pose, z_m in zip(low, (2.0, -0.2, 0.02)):
        pose[2, 3] = z_m
    assert not reachable(UR3E, BASE, MOUNT, path, low).any()
    tour = plan_tour(UR3E, BASE, MOUNT, path)
    assert tour.reached == len(set(tour.places)) > 5
    for before, joints in itertools.pairwise(tour.stops):
        assert not UR3E.singularities(joints) and np.abs(joints - before).max() <= FARTHEST_RAD
        assert is_free(UR3E, BASE, before, joints, path.floor_m).all()
    with pytest.raises(ArmError, match=r"reaches 0 of .* viewpoints: change radius_m"):
        plan_tour(UR3E, BASE, MOUNT, msgspec.structs.replace(path, radius_m=2.0))


def cell(**changed):
    arm = {"host": "127.0.0.2", "cameras": {"hand": None}, **changed}
    data = {"cameras": {"ids": ["hand", "still"]}, "source": {"kind": "world", "scene": "tile", "arm": arm}}
    return parse(data, CELL.path)


def test_a_camera_that_is_not_calibrated_yet_has_the_hands_poses_wherever_the_base_stands():
    scenario = cell(base_m=[1.0, 2.0, 3.0], base_yaw_deg=90.0)
    arm = source_config(scenario).arm
    mounts = load_hand_eyes(scenario, arm, scenario.cameras)
    assert list(mounts) == ["hand"] and np.array_equal(mounts["hand"].transform, np.eye(4))
    assert np.allclose(base_matrix(arm) @ [1, 0, 0, 1], [1, 3, 3, 1])


def test_a_wrong_file_or_host_is_refused_by_name():
    for changed, says in (
        # A simulated one is driven without a question.
        ({"host": "192.168.56.101", "simulated": True}, r"simulated: host is 192\.168"),
        ({"cameras": {"nobody": None}}, "arm.cameras: 'nobody' is not one of the scenario's cameras"),
        ({"cameras": {"hand": "no-such.yaml"}}, r"arm.cameras.hand: .*no-such.yaml: cannot be read"),
        ({"calibration": "no-such.conf"}, r"source.arm.calibration: .*no-such.conf: cannot be read"),
    ):
        scenario = cell(**changed)
        with pytest.raises(ScenarioError, match=says):
            load_hand_eyes(scenario, source_config(scenario).arm, scenario.cameras)
            arm_model(scenario, source_config(scenario).arm)


MS = 1_000_000
HELD = se3(so3_exp((0.1, 0, 0)), (0.05, 0, 0.1))


def written(tmp_path, **change):
    data = {"setup": "eye-in-hand", "transform": HELD.round(9).tolist(), "time_offset_s": 0.02, "method": "refined"}
    file = tmp_path / "hand.yaml"
    file.write_text(yaml.safe_dump({**data, **change}))
    return file


def test_a_camera_on_a_moving_flange_follows_it_and_one_that_stands_does_not(tmp_path):
    calibration = read_hand_eye(written(tmp_path))
    assert calibration.details == {"method": "refined"}
    flange = SampleBuffer(Pose.interpolate)
    for k in range(10):
        flange.add(k * 10 * MS, Pose.from_matrix(se3(so3_exp((0, 0, 0.1 * k)), (0.01 * k, 0, 0))))
    # The arm's stamps are 20 ms ahead: the camera's 30 ms are the arm's 50 ms.
    found, gap_ns = calibration.camera_poses(flange).at(30 * MS)
    expected = se3(so3_exp((0, 0, 0.5)), (0.05, 0, 0)) @ HELD
    np.testing.assert_allclose(found.matrix(), expected, atol=1e-8)
    assert gap_ns == 0
    stands = read_hand_eye(written(tmp_path, setup="eye-to-hand")).camera_poses(flange)
    np.testing.assert_allclose(stands.at(7)[0].matrix(), HELD, atol=1e-8)


def test_a_file_that_cannot_be_used_is_named(tmp_path):
    for change, message in (
        ({"setup": "eye-on-foot"}, "setup: expected eye-in-hand or eye-to-hand"),
        ({"transform": (2 * np.eye(4)).tolist()}, "transform: expected 4 x 4 numbers with the last row"),
        ({"transform": np.diag([1.0, 1, -1, 1]).tolist()}, "transform: the pose's rotation"),
        ({"transform": [[10**400] * 4] * 4}, "transform: .* too large"),
        ({"time_offset_s": float("nan")}, "time_offset_s"),
        ("[1, 2]", "expected setup and transform"),
    ):
        file = written(tmp_path, **(change if isinstance(change, dict) else {}))
        if isinstance(change, str):
            file.write_text(change)
        assert "hand.yaml" in str(refused(ArmError, message, read_hand_eye, file))
