import itertools

import msgspec
import numpy as np
import pytest

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.capsules import CapsuleModel
from camera_node.robot.arm.kinematics import UR3E, apply_calibration
from camera_node.robot.arm.viewpoint_tour import FARTHEST_RAD, _extend_tour, is_free, plan_tour, reachable, viewpoints
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.settings import PathConfig, source_config
from freshfield.scenario import ScenarioError, load, parse
from tests.camera_node.robot.arm.test_kinematics import CALIBRATION

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


def test_a_calibrated_arm_is_kept_above_the_floor_too(tmp_path):
    """The height of its joints, not of the frames that its calibration puts meters beside them."""
    file = tmp_path / "calibration.conf"
    file.write_text(CALIBRATION)
    arm = apply_calibration(UR3E, file)
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


@pytest.mark.parametrize(
    "changed, says",
    [
        # A simulated one is driven without a question.
        ({"host": "192.168.56.101", "simulated": True}, r"simulated: host is 192\.168"),
        ({"cameras": {"nobody": None}}, "arm.cameras: 'nobody' is not one of the scenario's cameras"),
        ({"cameras": {"hand": "no-such.yaml"}}, r"arm.cameras.hand: .*no-such.yaml: cannot be read"),
        ({"calibration": "no-such.conf"}, r"source.arm.calibration: .*no-such.conf: cannot be read"),
    ],
)
def test_a_wrong_file_or_host_is_refused_by_name(changed, says):
    scenario = cell(**changed)
    with pytest.raises(ScenarioError, match=says):
        load_hand_eyes(scenario, source_config(scenario).arm, scenario.cameras)
        arm_model(scenario, source_config(scenario).arm)
