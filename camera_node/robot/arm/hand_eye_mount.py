"""The saved hand-eye calibration, and poses of the camera from poses of the flange (4.7).

``camera-node calibrate hand-eye --out FILE`` writes the file::

    setup: eye-in-hand             # or eye-to-hand: the camera stands still, the flange holds the target
    transform: [[...], [...], [...], [0, 0, 0, 1]]   # camera in flange (4.2), or camera in base; meters
    time_offset_s: 0.0             # the arm's stamp of an instant minus the camera's
    ...                            # details of the calibration, for people
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.pose.providers import Closable, PoseProvider
from camera_node.robot.arm import ArmError
from freshfield.geometry import GeometryError, Pose
from freshfield.untrusted import UntrustedError, read_text, read_yaml

MAX_OFFSET_S = 1e6
"""Bound of the time offset: a larger one is the difference between two clocks' epochs."""
EYE_IN_HAND, EYE_TO_HAND = "eye-in-hand", "eye-to-hand"
SETUPS = (EYE_IN_HAND, EYE_TO_HAND)


@dataclass(frozen=True)
class HandEye:
    """A hand-eye calibration.

    setup: one of ``SETUPS``.
    transform: (4, 4), meters: T_EE^C for eye-in-hand, T_B^C for eye-to-hand.
    time_offset_s: the arm's stamp of an instant minus the camera's.
    details: the file's other keys.
    """

    setup: str
    transform: NDArray[np.float64]
    time_offset_s: float = 0.0
    details: dict[str, Any] = field(default_factory=dict)


class MountedCameraPoses:
    """Eye-in-hand: T_W^C(t) = T_W^EE(t) T_EE^C (4.7), with t on the arm's clock."""

    def __init__(self, flange: PoseProvider, calibration: HandEye) -> None:
        self._flange = flange
        self._transform = calibration.transform
        self._offset_ns = round(calibration.time_offset_s * 1e9)

    def at(self, t_ns: int) -> tuple[Pose, int]:
        """Pose of the camera at its stamp ``t_ns``. Raises PoseGapError."""
        flange, gap_ns = self._flange.at(t_ns + self._offset_ns)
        return Pose.from_matrix(flange.matrix() @ self._transform), gap_ns

    @property
    def refused(self) -> int:
        """See ``TrackerPoses``."""
        return getattr(self._flange, "refused", 0)

    def close(self) -> None:
        """Close the provider of the flange's poses."""
        if isinstance(self._flange, Closable):
            self._flange.close()


def read_hand_eye(path: Path) -> HandEye:
    """Read a hand-eye calibration. Raises ArmError."""
    try:
        data = read_yaml(read_text(path))
    except (OSError, UnicodeDecodeError, UntrustedError) as error:
        raise ArmError(f"{path}: cannot be read as YAML: {' '.join(str(error).split())}") from None
    if not isinstance(data, dict) or "transform" not in data:
        raise ArmError(f"{path}: expected setup and transform, as camera-node calibrate hand-eye --out writes")
    setup = data.pop("setup", EYE_IN_HAND)
    if setup not in SETUPS:
        raise ArmError(f"{path}: setup: expected {' or '.join(SETUPS)}, got {setup!r}")
    try:
        transform = rigid_transform(data.pop("transform"))
    except (ValueError, TypeError, OverflowError) as error:
        raise ArmError(f"{path}: transform: {error}") from None
    try:
        offset_s = float(data.pop("time_offset_s", 0.0))
        if not abs(offset_s) < MAX_OFFSET_S:
            raise ValueError
    except (ValueError, TypeError, OverflowError):
        raise ArmError(f"{path}: time_offset_s: expected seconds, less than {MAX_OFFSET_S:g} either way") from None
    return HandEye(setup, transform, offset_s, data)


def rigid_transform(value: object) -> NDArray[np.float64]:
    """Exactly rigid (4, 4) nearest to the rounded numbers of a file. Raises ValueError or TypeError."""
    matrix = np.array(value, dtype=np.float64)
    if matrix.shape != (4, 4) or not np.allclose(matrix[3], [0, 0, 0, 1]):
        shape = " x ".join(map(str, matrix.shape))
        raise GeometryError(f"expected 4 x 4 numbers with the last row 0 0 0 1, got {shape}")
    return Pose.from_matrix(matrix).matrix()
