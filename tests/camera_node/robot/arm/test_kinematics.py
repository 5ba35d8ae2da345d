import math

import numpy as np
import pytest

from camera_node.robot.arm.kinematics import UR3E, KinematicsError, apply_calibration
from freshfield.geometry import so3_exp

POSTURES = np.random.default_rng(3).uniform(-math.pi, math.pi, (40, 6))

# Deviations as large as real files have them: lengths along nearly parallel axes are ill-determined, so the
# factory's fit puts meters into d of joints 2 to 4 that all but cancel.
CALIBRATION = """
[mounting]
delta_theta = [ 4.1e-05, -0.0597, 0.1880, -0.1284, 1.9e-05, -3.7e-05]   # radians
delta_a = [ 3.7e-05, 4.3e-04, 1.5e-03, 3.5e-05, 5.1e-05, 0]
delta_d = [ 2.2e-04, -6.2913, 8.5694, -2.2780, -7.3e-05, 4.1e-04]
delta_alpha = [ 1.2e-04, 2.3e-03, 1.2e-02, 4.7e-04, -2.3e-04, 0]
calibration_status = 2
joint_checksum = [ 0x1, 0x2, 0x3, 0x4, 0x5, 0x6 ]
"""


@pytest.fixture
def factory(tmp_path):
    file = tmp_path / "calibration.conf"
    file.write_text(CALIBRATION)
    return file


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
        turn = np.eye(4)
        turn[:3, :3] = so3_exp(np.multiply(axis, angle))
        turn[:3, 3] = point - turn[:3, :3] @ point
        total = total @ turn
    home = np.eye(4)
    home[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]
    home[:3, 3] = -reach, -side - out, height - down
    return total @ home


def test_forward_is_the_product_of_exponentials():
    for q in POSTURES:
        assert np.abs(UR3E.forward(q) - by_exponentials(q)).max() < 1e-14
    np.testing.assert_array_equal(UR3E.forward(POSTURES), [UR3E.forward(q) for q in POSTURES])


def test_forward_and_jacobian_are_pinocchios():
    pin = pytest.importorskip("pinocchio", reason="needs pin: pip install -e '.[kinematics]'")
    model = pin.Model()
    before = pin.SE3.Identity()
    parent = 0
    for i in range(6):
        parent = model.addJoint(parent, pin.JointModelRZ(), before, f"joint{i}")
        place = pin.SE3(pin.utils.rotate("x", UR3E.alpha_rad[i]), np.array([UR3E.a_m[i], 0, UR3E.d_m[i]]))
        before = place
    flange = model.addFrame(pin.Frame("flange", parent, 0, before, pin.FrameType.OP_FRAME))
    data = model.createData()
    for q in POSTURES:
        pin.computeJointJacobians(model, data, q)
        pin.framesForwardKinematics(model, data, q)
        assert np.abs(data.oMf[flange].homogeneous - UR3E.forward(q)).max() < 1e-14
        theirs = pin.getFrameJacobian(model, data, flange, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
        assert np.abs(theirs - UR3E.jacobian(q)).max() < 1e-14


def test_the_inverse_finds_the_posture_and_only_such_as_reach_the_target():
    counts = set()
    for q in POSTURES:
        target = UR3E.forward(q)
        found = UR3E.inverse(target, near=q)
        counts.add(len(found))
        assert np.abs(found[0] - q).max() < 1e-9
        for posture in found:
            assert np.abs(UR3E.forward(posture) - target).max() < 1e-9
        apart = [np.abs(a - b).max() for a in found for b in found if a is not b]
        assert min(apart, default=1.0) > 1e-4
    assert counts <= {2, 4, 6, 8} and 8 in counts


def test_postures_are_turned_to_be_near_and_within_the_limits():
    q = np.array([3.5, -4.0, 1.0, -5.0, 2.0, 6.2])
    found = UR3E.inverse(UR3E.forward(q), near=q)
    assert np.abs(found[0] - q).max() < 1e-9
    assert all(np.abs(p).max() <= 2 * math.pi + 1e-9 for p in found)


def test_out_of_reach_has_no_posture():
    far = np.eye(4)
    far[:3, 3] = 0.7, 0.0, 0.2
    inside = np.eye(4)
    inside[:3, 3] = 0.05, 0.0, 0.3
    assert UR3E.inverse(far) == [] and UR3E.inverse(inside) == []


def test_singular_postures_are_named():
    free = np.array([0.3, -1.2, 1.1, -0.9, 1.4, 0.2])
    assert UR3E.singularities(free) == ()
    assert UR3E.singularities(np.where(np.arange(6) == 4, 0.01, free)) == ("wrist",)
    assert "elbow" in UR3E.singularities(np.where(np.arange(6) == 2, 0.0, free))
    above = free.copy()  # turn the upper arm until the wrist's centre is above the base
    turns = np.linspace(-math.pi, math.pi, 20001)
    least = [abs(np.linalg.det(UR3E.jacobian([0.3, t, *free[2:]]))) for t in turns[::10]]
    above[1] = turns[::10][int(np.argmin(least))]
    assert UR3E.singularities(above) == ("shoulder",)


def test_a_calibration_moves_the_hand_and_the_inverse_follows_it(factory):
    arm = apply_calibration(UR3E, factory)
    moved_m = []
    for q in POSTURES[:12]:
        target = arm.forward(q)
        moved_m.append(np.linalg.norm(target[:3, 3] - UR3E.forward(q)[:3, 3]))
        found = arm.inverse(target, near=q)
        if min(map(abs, (math.sin(q[2]), math.sin(q[4])))) > 0.1:
            assert np.abs(found[0] - q).max() < 1e-6
        for posture in found:
            assert np.abs(arm.forward(posture) - target).max() < 2e-7
    assert max(moved_m) > 1e-3


def test_a_calibration_of_zeros_changes_nothing(tmp_path):
    file = tmp_path / "calibration.conf"
    file.write_text("[mounting]\n" + "".join(f"delta_{k} = [0, 0, 0, 0, 0, 0]\n" for k in ("theta", "a", "d")))
    for q in POSTURES[:5]:
        assert np.array_equal(apply_calibration(UR3E, file).forward(q), UR3E.forward(q))


@pytest.mark.parametrize(
    "text, says",
    [
        ("[mounting]\ndelta_a = [1, 2]\n", "delta_a: expected a list of six numbers"),
        ("[mounting]\ndelta_a = [1, 2, 3, 4, 5, nan]\n", "delta_a: expected a list of six numbers"),
        ("[mounting]\nother = 1\n", "has no delta_theta"),
        ("delta_a = [0, 0, 0, 0, 0, 0]\n", "cannot be read"),
    ],
)
def test_a_wrong_calibration_is_refused_by_name(tmp_path, text, says):
    file = tmp_path / "calibration.conf"
    file.write_text(text)
    with pytest.raises(KinematicsError, match=says):
        apply_calibration(UR3E, file)


@pytest.mark.parametrize("joints", [[0] * 5, [0] * 7, [0, 0, 0, 0, 0, math.nan], [math.inf] + [0] * 5])
def test_joints_that_no_arm_has_are_refused(joints):
    with pytest.raises(KinematicsError, match="six finite"):
        UR3E.forward(joints)
