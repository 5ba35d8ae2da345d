from __future__ import annotations

import numpy as np
import pytest

from camera_node.robot.arm.capsules import PAIRS, PARTS, CapsuleModel, link_frames, segment_distance
from camera_node.robot.arm.kinematics import UR3E, apply_calibration
from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.limits import Limiter
from camera_node.robot.teleop.settings import TeleopConfig
from tests.camera_node.robot.arm.test_kinematics import CALIBRATION
from tests.camera_node.robot.teleop.checks import HOME

SHAPE = CapsuleModel(UR3E, 0.12, 0.04)
OPEN = TeleopConfig(workspace_low_m=(-1, -1, -1), workspace_high_m=(1, 1, 1), floor_m=-1.0)


def test_links_of_many_postures_are_those_of_each():
    q = np.random.default_rng(1).uniform(-6, 6, (7, 6))
    assert np.allclose(link_frames(UR3E, q), [UR3E.link_frames(each) for each in q], atol=1e-14)


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


def test_clearances_are_those_of_a_collision_library():
    pytest.importorskip("coal", reason="needs pinocchio: pip install -e '.[teleop]'")
    pin = pytest.importorskip("pinocchio", reason="needs pinocchio: pip install -e '.[teleop]'")
    from camera_node.robot.teleop.ik_solver import _model

    config = TeleopConfig(tool_m=0.12)
    model, collisions = _model(UR3E, config)
    data, found = model.createData(), collisions.createData()
    for q in np.random.default_rng(3).uniform(-3, 3, (40, 6)):
        pin.framesForwardKinematics(model, data, q)
        assert np.allclose(data.oMf[model.getFrameId("flange")].homogeneous, UR3E.forward(q), atol=1e-12)
        pin.computeDistances(model, data, collisions, found, q)
        theirs = np.array([each.min_distance for each in found.distanceResults])
        apart, lowest = SHAPE.clearance(link_frames(UR3E, q[None]))
        free = apart[0] > 0  # of parts that overlap the library gives a depth, we a distance of axes
        assert np.allclose(theirs[: len(PAIRS)][free], apart[0][free], atol=1e-5)
        floor = theirs[len(PAIRS) :].min() + config.floor_m - config.margin_m
        assert floor == pytest.approx(lowest[0], abs=1e-5)


def test_parts_of_a_calibrated_arm_stay_where_they_are(tmp_path):
    """Its link frames lie meters beside it: neither the limits nor pink may take them for the arm."""
    file = tmp_path / "calibration.conf"
    file.write_text(CALIBRATION)
    arm = apply_calibration(UR3E, file)
    assert np.abs(arm.link_frames(HOME) - UR3E.link_frames(HOME)).max() > 2.0
    shape, met = CapsuleModel(UR3E, OPEN.tool_m, OPEN.tool_radius_m), 0
    for q in np.random.default_rng(4).uniform(-3, 3, (60, 6)):
        apart_m = shape.clearance(link_frames(UR3E, q[None]))[0].min()
        if apart_m > OPEN.margin_m + 0.01:
            Limiter(arm, OPEN, q)
        elif apart_m < OPEN.margin_m - 0.01:
            met += 1
            with pytest.raises(TeleopError, match="mm apart"):
                Limiter(arm, OPEN, q)
    assert met > 10
    pin = pytest.importorskip("pinocchio", reason="needs pinocchio: pip install -e '.[teleop]'")
    from camera_node.robot.teleop.ik_solver import _model

    for q in np.random.default_rng(4).uniform(-3, 3, (20, 6)):
        distances = []
        for each in (UR3E, arm):
            model, collisions = _model(each, OPEN)
            found = collisions.createData()
            pin.computeDistances(model, model.createData(), collisions, found, q)
            distances.append([pair.min_distance for pair in found.distanceResults])
        theirs, ours = np.array(distances)
        both = (theirs > 0) & (ours > 0)
        assert np.abs(theirs - ours)[both].max() < 0.02


def test_a_folded_arm_meets_itself_and_home_does_not():
    apart, _ = SHAPE.clearance(link_frames(UR3E, HOME[None]))
    assert apart.min() > 0.02
    folded = HOME.copy()
    folded[2] = -np.pi + 0.05
    apart, _ = SHAPE.clearance(link_frames(UR3E, folded[None]))
    met = {(PARTS[a], PARTS[b]) for (a, b), gap in zip(PAIRS, apart[0]) if gap < 0}
    assert ("upper arm", "wrist 1") in met
