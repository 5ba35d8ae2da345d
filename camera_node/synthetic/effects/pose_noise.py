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

    correlation_s: Annotated[
        float, within(0.0, 1e6, "time within which errors change smoothly, as of a tracker that drifts; 0: independent")
    ] = 0.0

    kind: ClassVar[str] = "pose"

    def __post_init__(self) -> None:
        if 0.0 < self.correlation_s < 1e-3:
            raise ValueError(f"correlation_s must be 0 or at least 0.001, got {self.correlation_s}")

    def start(self, rng: np.random.Generator) -> NoisyPose:
        return NoisyPose(self, rng)


class NoisyPose:
    """One camera's pose error; a frame's error depends only on the camera's random stream and the frame's
    number, or its instant if errors are correlated."""

    def __init__(self, parameters: PoseNoise, rng: np.random.Generator) -> None:
        p = parameters
        self._correlation_s = p.correlation_s
        self._key = rng.integers(0, 2**64, size=2, dtype=np.uint64)
        self._sigma = np.array([np.deg2rad(p.rotation_deg)] * 3 + [1e-3 * p.translation_mm] * 3)
        bias = np.array([np.deg2rad(p.rotation_bias_deg)] * 3 + [1e-3 * p.translation_bias_mm] * 3)
        self._bias = bias * rng.standard_normal(6)

    @property
    def varies(self) -> bool:
        return bool(self._sigma.any())

    def reported(self, pose: Pose, index: int, t_s: float) -> Pose:
        matrix = pose.matrix()
        _displace(matrix, self._bias)
        if self.varies:
            draw = self._smooth(t_s) if self._correlation_s else frame_rng(self._key, index).standard_normal(6)
            _displace(matrix, self._sigma * draw)
        return Pose.from_matrix(matrix)

    def _smooth(self, t_s: float) -> Array:
        """Six normal numbers that change smoothly: independent knots every ``correlation_s``, between which Catmull and
        Rom's cubic goes, divided by the standard deviation that it has there."""
        knot, x = divmod(t_s / self._correlation_s, 1.0)
        weights = np.array(
            [-x + 2 * x**2 - x**3, 2 - 5 * x**2 + 3 * x**3, x + 4 * x**2 - 3 * x**3, x**3 - x**2], dtype=np.float64
        )
        weights /= np.sqrt(weights @ weights)
        # Instants before the epoch wrap: a counter is not negative.
        knots = [frame_rng(self._key, (int(knot) + k) % 2**63).standard_normal(6) for k in range(-1, 3)]
        return np.asarray(weights @ np.array(knots), dtype=np.float64)


def _displace(matrix: Array, error: Array) -> None:
    matrix[:3, :3] = matrix[:3, :3] @ so3_exp(error[:3])
    matrix[:3, 3] += error[3:]
