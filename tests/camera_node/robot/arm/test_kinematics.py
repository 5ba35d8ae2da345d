"""The arm's geometry, where it carries its camera, T_W^C = T_W^EE T_EE^C (4.7), and the tour of viewpoints."""

import itertools
import math

import msgspec
import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from camera_node.pose.pairing import SampleBuffer
from camera_node.robot.arm import ArmError
from camera_node.robot.arm.arm_constants import FARTHEST_RAD
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.capsules import PAIRS, CapsuleModel, segment_distance
from camera_node.robot.arm.hand_eye_mount import MountedCameraPoses, read_hand_eye
from camera_node.robot.arm.kinematics import UR3E, apply_calibration
from camera_node.robot.arm.settings import PathConfig
from camera_node.robot.arm.tour_planning import is_free, plan_tour, reachable, viewpoints
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.settings import source_config
from freshfield.geometry import Pose, se3, so3_exp
from freshfield.scenario import ScenarioError, load, parse
from tests.support import refused

POSTURES = np.random.default_rng(3).uniform(-math.pi, math.pi, (40, 6))
angles = st.floats(-math.pi, math.pi, allow_subnormal=False)


def by_exponentials(joints):
    """The flange by a product of exponentials: screw axes read off the arm stretched out along its -x, as the
    data sheet draws it; nothing is shared with the Denavit-Hartenberg chain."""
    height, upper, lower, side, down, out = 0.15185, 0.24355, 0.2132, 0.13105, 0.08535, 0.0921
    reach = upper + lower
    screws = [
        ((0, 0, 1), (0, 0, 0)),
        ((0, -1, 0), (0, 0, height)),
        ((0, -1, 0), (-upper, 0, height)),
        ((0, -1, 0), (-reach, 0, height)),
        ((0, 0, -1), (-reach, -side, 0)),
        ((0, -1, 0), (-reach, 0, height - down)),
    ]
    total = np.eye(4)
    for (axis, point), angle in zip(screws, joints):
        turn = so3_exp(np.multiply(axis, angle))
        total = total @ se3(turn, point - turn @ point)
    return total @ se3([[1, 0, 0], [0, 0, -1], [0, 1, 0]], [-reach, -side - out, height - down])


def test_forward_is_the_product_of_exponentials_and_the_jacobian_its_derivative():
    flanges = UR3E.forward(POSTURES)
    for q, flange in zip(POSTURES, flanges):
        assert np.abs(flange - by_exponentials(q)).max() < 1e-14
        assert np.array_equal(UR3E.forward(q), flange)
        steps = 1e-6 * np.eye(6)
        ends = UR3E.forward(q + steps), UR3E.forward(q - steps)
        linear = (ends[0] - ends[1])[:, :3, 3].T / 2e-6
        turns = (ends[0] - ends[1])[:, :3, :3] @ flange[:3, :3].T / 2e-6
        angular = np.array([turns[:, 2, 1], turns[:, 0, 2], turns[:, 1, 0]])
        np.testing.assert_allclose(UR3E.jacobian(q), np.concatenate([linear, angular]), atol=1e-8)


def check(q):
    """Every posture that is found reaches the target, and there is one, but where a straight wrist leaves joints 4
    and 6 free and the arm is stretched."""
    target = UR3E.forward(q)
    found = np.reshape(UR3E.inverse(target), (-1, 6))
    assert len(found) or UR3E.singular(q)
    assert np.abs(UR3E.forward(found) - target).max(initial=0.0) < 1e-7
    return found


def test_singular_postures_are_known_and_a_joint_turns_a_full_turn_either_way():
    assert np.degrees((UR3E.lower_rad, UR3E.upper_rad)) == pytest.approx(np.array([[-360.0] * 6, [360.0] * 6]))
    free = np.array([0.3, -1.2, 1.1, -0.9, 1.4, 0.2])
    wrist = [np.where(np.arange(6) == 4, np.radians(angle), free) for angle in (4.9, 5.1)]
    assert UR3E.singular([free, *wrist, np.where(np.arange(6) == 2, 0.0, free)]).tolist() == [False, True, False, True]


def test_a_calibration_moves_the_flange_and_the_inverse_follows_it(factory):
    arm = apply_calibration(UR3E, factory)
    assert np.linalg.norm((arm.forward(POSTURES) - UR3E.forward(POSTURES))[:, :3, 3], axis=1).max() > 1e-3
    for q in POSTURES[:12]:
        found = arm.inverse(arm.forward(q))
        if min(map(abs, (math.sin(q[2]), math.sin(q[4])))) > 0.1:
            assert min(np.abs(np.sin(each - q)).max() for each in found) < 1e-6
        assert np.abs(arm.forward(np.reshape(found, (-1, 6))) - arm.forward(q)).max(initial=0.0) < 2e-7
    factory.write_text("[mounting]\n" + "".join(f"delta_{k} = [0, 0, 0, 0, 0, 0]\n" for k in ("theta", "a", "d")))
    assert np.array_equal(apply_calibration(UR3E, factory).forward(POSTURES), UR3E.forward(POSTURES))


def test_a_wrong_calibration_and_joints_that_no_arm_has_are_refused(factory):
    for text, says in (
        ("[mounting]\ndelta_a = [1, 2, 3, 4, 5, nan]\n", "delta_a: expected a list of six numbers"),
        ("[mounting]\nother = 1\n", "has no delta_theta"),
        ("delta_a = [0, 0, 0, 0, 0, 0]\n", "cannot be read"),
    ):
        factory.write_text(text)
        refused(ArmError, says, apply_calibration, UR3E, factory)
    for joints in ([0] * 5, [0] * 7, [0, 0, 0, 0, 0, math.nan]):
        refused(ArmError, "six finite", UR3E.forward, joints)


@pytest.mark.stability
@pytest.mark.parametrize("away", [0.0, 1e-300, 1e-16, 1e-10, 1e-8, 1e-4, 1e-2])
def test_at_and_about_singular_postures(away):
    for straight in (0.0, math.pi):
        q = np.array([0.4, -1.1, 1.3, -0.8, straight - away, 0.7])
        assert UR3E.singular(check(q)).any()
    for elbow in (away, -away, math.pi - away):
        assert UR3E.singular(check(np.array([0.4, -1.1, elbow, -0.8, 1.2, 0.7]))).any()
    above = np.array([0.4, 0.0, 1.3, -0.8, 1.2, 0.7])
    low, high = 0.0, math.pi  # the Jacobian's determinant changes its sign where the wrist is above the base
    sign = np.sign(np.linalg.det(UR3E.jacobian(above)))
    for _ in range(80):
        above[1] = 0.5 * (low + high)
        low, high = (above[1], high) if np.sign(np.linalg.det(UR3E.jacobian(above))) == sign else (low, above[1])
    above[1] += away
    assert UR3E.singular(check(above)).any()


@pytest.mark.stability
@given(st.tuples(*[st.one_of(angles, st.sampled_from([0.0, math.pi, -math.pi / 2, 1e-9]))] * 6))
def test_whatever_the_posture_the_target_is_reached(q):
    check(np.array(q))


@pytest.mark.stability
@given(st.lists(st.floats(-2, 2), min_size=3, max_size=3), st.lists(angles, min_size=3, max_size=3))
def test_whatever_the_target_postures_reach_it_or_are_none(where, turn):
    target = se3(so3_exp(turn), where)
    for posture in UR3E.inverse(target):
        assert np.abs(UR3E.forward(posture) - target).max() < 1e-7


@pytest.mark.stability
def test_a_calibrated_arm_next_to_a_singularity_reaches_what_it_is_said_to_or_nothing(factory):
    arm = apply_calibration(UR3E, factory)
    for elbow, wrist in itertools.product((0.0, 1e-9, 1e-4, 0.02), (0.0, 1e-9, 1e-4, 0.02)):
        target = arm.forward(np.array([0.4, -1.1, elbow, -0.8, wrist, 0.7]))
        for posture in arm.inverse(target):
            assert np.abs(arm.forward(posture) - target).max() < 2e-7


def test_distance_of_segments_is_the_least_of_all_their_points():
    rng = np.random.default_rng(2)
    a, b, c, d = rng.uniform(-1, 1, (4, 60, 3))
    b[:5], d[5:10] = a[:5], c[5:10]  # points
    d[10:20] = c[10:20] + (b - a)[10:20] * rng.uniform(-2, 2, (10, 1))  # parallel ones
    share = np.linspace(0, 1, 161)
    on_ab = a[:, None] + share[:, None] * (b - a)[:, None]
    on_cd = c[:, None] + share[:, None] * (d - c)[:, None]
    least = np.linalg.norm(on_ab[:, :, None] - on_cd[:, None], axis=-1).min(axis=(1, 2))
    found = segment_distance(a, b, c, d)
    assert (found <= least + 1e-12).all()
    assert (least - found).max() < 0.01


def test_parts_of_the_stretched_arm_lie_where_the_manufacturer_describes_them():
    """Along -x, the upper arm 119.8 mm and the forearm 27.3 mm aside of the joints' axes."""
    shape, frames = CapsuleModel(UR3E, 0.12, 0.04), UR3E.link_frames(np.zeros((1, 6)))
    a, b = (ends[0] for ends in shape.segments(frames))
    height, elbow, wrist = 0.15185, -0.24355, -0.24355 - 0.2132
    np.testing.assert_allclose([a[2], b[2]], [[0, -0.1198, height], [elbow, -0.1198, height]], atol=1e-12)
    np.testing.assert_allclose([a[3], b[3]], [[elbow, -0.0273, height], [wrist, -0.0273, height]], atol=1e-12)
    # The tool is a capsule of 120 mm from the flange on; its ends are one radius inside.
    flange = np.array([wrist, -0.13105 - 0.0921, height - 0.08535])
    np.testing.assert_allclose([a[7], b[7]], np.add(flange, [[0, -0.04, 0], [0, -0.08, 0]]), atol=1e-12)
    apart, lowest = shape.clearance(frames)
    # Base (radius 64 mm) and forearm (40 mm): from the top of the column to the elbow's end.
    assert apart[0][PAIRS.index((0, 3))] == pytest.approx(np.hypot(0.24355, 0.0273) - 0.064 - 0.04)
    assert lowest[0] == pytest.approx(height - 0.08535 - 0.04)


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
        assert not UR3E.singular(joints) and np.abs(joints - before).max() <= FARTHEST_RAD
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


def test_a_camera_on_a_moving_flange_follows_it(tmp_path):
    calibration = read_hand_eye(written(tmp_path))
    assert calibration.details == {"method": "refined"}
    flange = SampleBuffer(Pose.interpolate)
    for k in range(10):
        flange.add(k * 10 * MS, Pose.from_matrix(se3(so3_exp((0, 0, 0.1 * k)), (0.01 * k, 0, 0))))
    # The arm's stamps are 20 ms ahead: the camera's 30 ms are the arm's 50 ms.
    found, gap_ns = MountedCameraPoses(flange, calibration).at(30 * MS)
    np.testing.assert_allclose(found.matrix(), se3(so3_exp((0, 0, 0.5)), (0.05, 0, 0)) @ HELD, atol=1e-8)
    assert gap_ns == 0


def test_a_file_that_cannot_be_used_is_named(tmp_path):
    for change, message in (
        ({"setup": "eye-on-foot"}, "setup: expected eye-in-hand or eye-to-hand"),
        ({"transform": np.diag([1.0, 1, -1, 1]).tolist()}, "transform: the pose's rotation"),
        ({"transform": [[10**400] * 4] * 4}, "transform: .* too large"),
        ({"time_offset_s": float("nan")}, "time_offset_s"),
        ("[1, 2]", "expected setup and transform"),
    ):
        file = written(tmp_path, **(change if isinstance(change, dict) else {}))
        if isinstance(change, str):
            file.write_text(change)
        assert "hand.yaml" in str(refused(ArmError, message, read_hand_eye, file))
