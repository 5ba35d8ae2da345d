"""Pairs of poses as programs save them."""

from __future__ import annotations

import json

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, EYE_TO_HAND
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.pose_pairs import read_pairs
from freshfield.geometry import se3, se3_inverse, so3_exp

FLANGES = np.array([se3(so3_exp([0.1 * k, 0.2, -0.3]), [0.1, 0.2 * k, 0.3]) for k in range(3)])
TARGETS = np.array([se3(so3_exp([0.3, -0.2 * k, 0.1]), [0.0, 0.1, 0.4 + k]) for k in range(3)])


def seven(pose: np.ndarray) -> list[float]:
    """x y z qx qy qz qw, as ROS orders them."""
    return [*pose[:3, 3].tolist(), *Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()]


def named(pose: np.ndarray, shift: str = "translation", turn: str = "rotation") -> dict:
    numbers = seven(pose)
    return {shift: dict(zip("xyz", numbers[:3])), turn: dict(zip("xyzw", numbers[3:]))}


def flat(pose: np.ndarray) -> list[float]:
    return pose.ravel().tolist()


def easy_handeye2(flanges: np.ndarray) -> dict:
    return {"samples": [{"robot": named(h), "tracking": named(t)} for h, t in zip(flanges, TARGETS)]}


PAIRS = list(zip(FLANGES, TARGETS))
FORMS = {
    "ours": [[h.tolist(), t.tolist()] for h, t in PAIRS],
    "numbers": [[seven(h), seven(t)] for h, t in PAIRS],
    "poses": [[{"header": {}, "pose": named(h, "position", "orientation")}, {"transform": named(t)}] for h, t in PAIRS],
    "MoveIt": [{"effector_wrt_world": flat(h), "object_wrt_sensor": flat(t)} for h, t in PAIRS],
    "easy_handeye2": easy_handeye2(FLANGES),
    "easy_handeye": {
        "hand_world_samples": {"transforms": [named(h) for h in FLANGES]},
        "camera_marker_samples": {"transforms": [named(t) for t in TARGETS]},
    },
}


@pytest.mark.parametrize("form", FORMS)
def test_every_form_is_the_same_pairs(form, tmp_path):
    for suffix, write in (("json", json.dumps), ("yaml", yaml.safe_dump)):
        file = tmp_path / f"pairs.{suffix}"
        file.write_text(write(FORMS[form]))
        found = read_pairs(file, EYE_IN_HAND)
        np.testing.assert_allclose(found.flange, FLANGES, atol=1e-9)
        np.testing.assert_allclose(found.target, TARGETS, atol=1e-9)


def test_easy_handeye_saves_the_base_in_the_flange_for_a_camera_that_stands(tmp_path):
    file = tmp_path / "eye_on_base.samples"
    for form in (easy_handeye2(se3_inverse(FLANGES)), FORMS["MoveIt"]):
        file.write_text(yaml.safe_dump(form))
        np.testing.assert_allclose(read_pairs(file, EYE_TO_HAND).flange, FLANGES, atol=1e-9)


@pytest.mark.parametrize(
    ("data", "says"),
    [
        ("{", "cannot be read as JSON"),
        ({"poses": []}, "expected a list of pairs .*or the samples of MoveIt's panel or easy_handeye"),
        ({"hand_world_samples": {"transforms": [1]}, "camera_marker_samples": {"transforms": []}}, "expected a list"),
        ([[1]], "pair 1"),
        ([[[[10**400] * 4] * 4] * 2], "pair 1"),
        ([{"robot": named(FLANGES[0])}], "pair 1: .*tracking"),
        ([[[0.0] * 6 + [1.02], seven(TARGETS[0])]], "pair 1: .*no unit quaternion"),
        ([[seven(FLANGES[0])[:6], seven(TARGETS[0])]], "pair 1: .*4 x 4"),
    ],
)
def test_what_is_none_of_them_is_refused_by_name(data, says, tmp_path):
    file = tmp_path / "pairs.json"
    file.write_text(data if isinstance(data, str) else json.dumps(data))
    with pytest.raises(CalibrationError, match=f"pairs.json: {says}") as error:
        read_pairs(file, EYE_IN_HAND)
    assert "\n" not in str(error.value)
