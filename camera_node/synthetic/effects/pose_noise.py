"""Pose noise: frames report poses with errors of calibration and tracking.

Images are taken from the true pose; only the reported pose is wrong.
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from camera_node.synthetic.effects import EffectParameters, frame_rng
from freshfield.geometry import Array, Pose, so3_exp
from freshfield.settings import within


class PoseNoise(EffectParameters, frozen=True):
    """Rotations by a normal rotation vector in camera axes, translations in world axes; standard deviations on each
    axis. About .1 ms a frame."""

    translation_mm: Annotated[float, within(0.0, 1e5, "error of each frame, as of a tracker or an arm")] = 5.0
    rotation_deg: Annotated[float, within(0.0, 180.0, "the same of the rotation")] = 0.2
    translation_bias_mm: Annotated[float, within(0.0, 1e5, "each camera's constant error, as of a calibration")] = 0.0
    rotation_bias_deg: Annotated[float, within(0.0, 180.0, "the same of the rotation")] = 0.0

    kind: ClassVar[str] = "pose"

    def start(self, rng: np.random.Generator) -> NoisyPose:
        return NoisyPose(self, rng)


class NoisyPose:
    """One camera's pose error; a frame's error depends only on the camera's random stream and the frame's
    number."""

    def __init__(self, parameters: PoseNoise, rng: np.random.Generator) -> None:
        p = parameters
        self._key = rng.integers(0, 2**64, size=2, dtype=np.uint64)
        self._sigma = np.array([np.deg2rad(p.rotation_deg)] * 3 + [1e-3 * p.translation_mm] * 3)
        bias = np.array([np.deg2rad(p.rotation_bias_deg)] * 3 + [1e-3 * p.translation_bias_mm] * 3)
        self._bias = bias * rng.standard_normal(6)

    @property
    def varies(self) -> bool:
        return bool(self._sigma.any())

    def reported(self, pose: Pose, index: int) -> Pose:
        matrix = pose.matrix()
        _displace(matrix, self._bias)
        if self.varies:
            _displace(matrix, self._sigma * frame_rng(self._key, index).standard_normal(6))
        return Pose.from_matrix(matrix)


def _displace(matrix: Array, error: Array) -> None:
    matrix[:3, :3] = matrix[:3, :3] @ so3_exp(error[:3])
    matrix[:3, 3] += error[3:]
