"""A camera on a hand: the saved hand-eye calibration, and poses of the camera from poses of the hand (4.7).

The file is what ``camera-node calibrate hand-eye --out FILE`` writes::

    setup: eye-in-hand             # or eye-to-hand: the camera stands still, the hand holds the target
    transform: [[...], [...], [...], [0, 0, 0, 1]]   # camera in hand (4.2), or camera in base; metres
    time_offset_s: 0.0             # the arm's stamp of an instant minus the camera's
    ...                            # how it was found, for people
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from camera_node.pose.providers import Closable, FixedPose, PairedPose, PoseProvider
from freshfield.geometry import GeometryError, Pose

# Of a file: more is the difference of two clocks' beginnings, such as 1970 and a machine's start.
MAX_OFFSET_S = 1e6
EYE_IN_HAND, EYE_TO_HAND = "eye-in-hand", "eye-to-hand"
SETUPS = (EYE_IN_HAND, EYE_TO_HAND)


class HandEyeError(ValueError):
    """A hand-eye file that cannot be used; the message names the file and what is wrong in it."""


@dataclass(frozen=True)
class HandEye:
    """transform: (4, 4), metres: T_EE^C for eye-in-hand, T_B^C for eye-to-hand. time_offset_s: add it to a
    camera's stamp to have the arm's."""

    setup: str
    transform: NDArray[np.float64]
    time_offset_s: float = 0.0
    details: dict[str, Any] = field(default_factory=dict)

    def camera_poses(self, hand: PoseProvider) -> PoseProvider:
        """Poses of the camera in the base's axes, given those of the hand."""
        if self.setup == EYE_TO_HAND:
            return FixedPose(Pose.from_matrix(self.transform))
        return MountedCameraPoses(hand, self)


class MountedCameraPoses:
    """Eye-in-hand: T_W^C(t) = T_W^EE(t) T_EE^C (4.7), with t on the arm's clock."""

    def __init__(self, hand: PoseProvider, calibration: HandEye) -> None:
        self._hand = hand
        self._transform = calibration.transform
        self._offset_ns = round(calibration.time_offset_s * 1e9)

    def at(self, t_ns: int) -> PairedPose:
        """Raises PoseGapError where the hand has no pose near enough."""
        paired = self._hand.at(t_ns + self._offset_ns)
        return PairedPose(Pose.from_matrix(paired.pose.matrix() @ self._transform), paired.gap_ns)

    def close(self) -> None:
        """Let go of what gives the hand's poses."""
        if isinstance(self._hand, Closable):
            self._hand.close()


def read_hand_eye(path: Path) -> HandEye:
    """Raises HandEyeError, one line naming file and key."""
    try:
        data = yaml.safe_load(path.read_text())
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise HandEyeError(f"{path}: cannot be read as YAML: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict) or "transform" not in data:
        raise HandEyeError(
            f"{path}: expected setup and transform, as camera-node calibrate hand-eye --out writes"
        )
    setup = data.pop("setup", EYE_IN_HAND)
    if setup not in SETUPS:
        raise HandEyeError(f"{path}: setup: expected {' or '.join(SETUPS)}, got {setup!r}")
    try:
        matrix = np.array(data.pop("transform"), dtype=np.float64)
        if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
            raise GeometryError("expected 4 x 4 numbers with the last row 0 0 0 1")
        # Digits in a file are rounded: what is loaded is exactly rigid.
        transform = Pose.from_matrix(matrix).matrix()
    except (ValueError, TypeError) as error:
        raise HandEyeError(f"{path}: transform: {error}") from None
    try:
        offset_s = float(data.pop("time_offset_s", 0.0))
        if not abs(offset_s) < MAX_OFFSET_S:
            raise ValueError
    except (ValueError, TypeError):
        raise HandEyeError(
            f"{path}: time_offset_s: expected seconds, less than {MAX_OFFSET_S:g} either way"
        ) from None
    return HandEye(setup, transform, offset_s, data)
