"""Pairs of poses from files: our own, and those of MoveIt's panel, easy_handeye and other programs of ROS.

A pair is the flange in the arm's base and the target in the camera. A file, JSON or YAML, holds one of

    [[POSE, POSE], ...]                                          flange and target
    [{effector_wrt_world: POSE, object_wrt_sensor: POSE}, ...]   MoveIt's calibration panel
    {samples: [{robot: POSE, tracking: POSE}, ...]}              easy_handeye2
    {hand_world_samples: {transforms: [POSE, ...]}, camera_marker_samples: {transforms: [POSE, ...]}}   easy_handeye

and a POSE is a matrix of 4 x 4 or 16 numbers, [x, y, z, qx, qy, qz, qw], or a pose or transform of ROS.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, rigid_transform
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.calibration_constants import MOST_QUATERNION_ERROR
from camera_node.robot.calibration.hand_eye.samples import Array, Samples
from freshfield.geometry import quaternion_to_matrix, se3, se3_inverse
from freshfield.untrusted import UntrustedError, read_json, read_text, read_yaml

_EASY_HANDEYE = ("robot", "tracking")
_NAMES = (("effector_wrt_world", "object_wrt_sensor"), _EASY_HANDEYE)


def read_pairs(file: Path, setup: str) -> Samples:
    """Samples from a file of pairs. Raises CalibrationError."""
    try:
        text = read_text(file)
        data = read_json(text) if file.suffix.lower() == ".json" else read_yaml(text)
    except (OSError, UnicodeDecodeError, UntrustedError) as error:
        kind = "JSON" if file.suffix.lower() == ".json" else "YAML"
        raise CalibrationError(f"{file}: cannot be read as {kind}: {' '.join(str(error).split())}") from None
    pairs, inverted = _listed(data), False
    if pairs is None:
        raise CalibrationError(
            f"{file}: expected a list of pairs [flange in base, target in camera], or the samples of MoveIt's panel or "
            "easy_handeye"
        )
    flanges, targets = [], []
    for k, pair in enumerate(pairs):
        try:
            names = next((each for each in _NAMES if isinstance(pair, dict) and each[0] in pair), None)
            flange, target = pair if names is None else (pair[name] for name in names)
            inverted |= names == _EASY_HANDEYE
            flanges.append(read_pose(flange))
            targets.append(read_pose(target))
        except (ValueError, TypeError, OverflowError, KeyError) as error:
            raise CalibrationError(
                f"{file}: pair {k + 1}: expected [flange in base, target in camera]: {error}"
            ) from None
    flange_poses = np.reshape(flanges, (-1, 4, 4))
    if inverted and setup != EYE_IN_HAND:  # there easy_handeye saves the base in the flange
        flange_poses = se3_inverse(flange_poses)
    return Samples(flange_poses, np.reshape(targets, (-1, 4, 4)), setup)


def _listed(data: Any) -> list[Any] | None:
    """The pairs of a file's value; None if it is of no known form."""
    if isinstance(data, dict) and "samples" in data:
        data = data["samples"]
    if isinstance(data, dict):
        try:
            hands, markers = (data[name]["transforms"] for name in ("hand_world_samples", "camera_marker_samples"))
            return [dict(zip(_EASY_HANDEYE, pair)) for pair in zip(hands, markers, strict=True)]
        except (KeyError, TypeError, ValueError):
            return None
    return data if isinstance(data, list) else None


def read_pose(value: Any) -> Array:
    """A pose (4, 4) in one of the forms above. Raises ValueError, TypeError, OverflowError or KeyError."""
    if isinstance(value, dict):
        for wrapper in ("transform", "pose"):
            if wrapper in value:
                return read_pose(value[wrapper])
        shift, turn = ("translation", "rotation") if "rotation" in value else ("position", "orientation")
        value = [*_components(value[shift], "xyz"), *_components(value[turn], "xyzw")]
    numbers = np.array(value, dtype=np.float64)
    if numbers.shape == (16,):
        numbers = numbers.reshape(4, 4)
    if numbers.shape != (7,):
        return rigid_transform(numbers)
    if abs(np.linalg.norm(numbers[3:]) - 1.0) > MOST_QUATERNION_ERROR or not np.isfinite(numbers).all():
        raise ValueError("the last four of seven numbers are no unit quaternion (qx qy qz qw)")
    return se3(quaternion_to_matrix(numbers[[6, 3, 4, 5]]), numbers[:3])


def _components(value: Any, names: str) -> list[float]:
    return [value[name] for name in names] if isinstance(value, dict) else list(value)
