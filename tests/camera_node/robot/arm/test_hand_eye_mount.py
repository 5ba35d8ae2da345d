"""The saved hand-eye calibration: T_W^C = T_W^EE T_EE^C (4.7), on the arm's clock."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from camera_node.pose.pairing import SampleBuffer
from camera_node.robot.arm import ArmError
from camera_node.robot.arm.hand_eye_mount import read_hand_eye
from freshfield.geometry import Pose, se3, so3_exp

MS = 1_000_000
MOUNT = se3(so3_exp((0.1, 0, 0)), (0.05, 0, 0.1))


def written(tmp_path, **change):
    data = {"setup": "eye-in-hand", "transform": MOUNT.round(9).tolist(), "time_offset_s": 0.02, "method": "refined"}
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
    expected = se3(so3_exp((0, 0, 0.5)), (0.05, 0, 0)) @ MOUNT
    np.testing.assert_allclose(found.matrix(), expected, atol=1e-8)
    assert gap_ns == 0
    stands = read_hand_eye(written(tmp_path, setup="eye-to-hand")).camera_poses(flange)
    np.testing.assert_allclose(stands.at(7)[0].matrix(), MOUNT, atol=1e-8)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"setup": "eye-on-foot"}, "setup: expected eye-in-hand or eye-to-hand"),
        ({"transform": (2 * np.eye(4)).tolist()}, "transform: expected 4 x 4 numbers with the last row"),
        ({"transform": np.diag([1.0, 1, -1, 1]).tolist()}, "transform: the pose's rotation"),
        ({"transform": [[10**400] * 4] * 4}, "transform: .* too large"),
        ({"time_offset_s": float("nan")}, "time_offset_s"),
        ("[1, 2]", "expected setup and transform"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path, change, message):
    file = written(tmp_path, **(change if isinstance(change, dict) else {}))
    if isinstance(change, str):
        file.write_text(change)
    with pytest.raises(ArmError, match=message) as error:
        read_hand_eye(file)
    assert "hand.yaml" in str(error.value)
