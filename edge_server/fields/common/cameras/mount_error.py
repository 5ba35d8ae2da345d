"""The part of all pose corrections of one carried camera that is the same in its own axes: where it is mounted wrongly.

A pose T (camera to world) becomes G T C: C is of the camera (a hand-eye calibration, a tracker's place beside it), G of
the world, which nothing holds, and the rest are errors of single poses. For small corrections both follow from linear
least squares. How well is told by leaving out one part of the path after the other (jackknife), since errors of
neighboring poses are alike: what a camera has turned too little to tell C from G by comes out differently each time.
Corrections of a short path are all alike, so that how much the camera has turned is asked, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.cameras import camera_refinement_constants as tuned
from freshfield.geometry import so3_log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ConstantCorrection:
    """What all poses have in common.

    rotation_deg, shift_mm: (3,), rotation vector and shift in the camera's axes, from the given to the true camera.
    error_deg, error_mm: their standard errors, of all axes together.
    scatter_deg, scatter_mm: root mean square length of what is left of single poses.
    told: whether the camera has turned enough, about two axes, to tell its own part from the world's.
    """

    rotation_deg: Array
    shift_mm: Array
    error_deg: float
    error_mm: float
    scatter_deg: float
    scatter_mm: float
    told: bool

    @property
    def cancels_m(self) -> float | None:
        """How far before the camera a turn and a shift sideways undo each other, meters; None where they do not. Of
        such a pair long refinement brings forth more and more: pictures of what is there hardly tell."""
        turn = np.deg2rad(self.rotation_deg)
        sideways, shift = np.array([turn[1], -turn[0]]), 1e-3 * self.shift_mm[:2]  # turn x (0, 0, 1)
        away_m = -float(sideways @ shift) / max(float(sideways @ sideways), 1e-12)
        left = np.linalg.norm(shift + away_m * sideways)
        near, far = tuned.CANCELS_M
        return away_m if near < away_m < far and left < tuned.CANCELS * np.linalg.norm(shift) else None

    @property
    def sure(self) -> bool:
        """Whether a constant part is beyond doubt."""
        if not self.told or self.cancels_m is not None:
            return False
        turned, shifted = float(np.linalg.norm(self.rotation_deg)), float(np.linalg.norm(self.shift_mm))
        return turned > max(tuned.SURE * self.error_deg, tuned.STANDS_OUT * self.scatter_deg) or shifted > max(
            tuned.SURE * self.error_mm, tuned.STANDS_OUT * self.scatter_mm
        )

    @property
    def words(self) -> str:
        """One line for people; a hint to calibrate where it is sure."""
        turned, shifted = float(np.linalg.norm(self.rotation_deg)), float(np.linalg.norm(self.shift_mm))
        single = f"single poses scatter by {self.scatter_deg:.2f} degrees and {self.scatter_mm:.1f} mm"
        if not self.sure:
            why = "" if self.cancels_m is None else f" (a turn and a shift that cancel {self.cancels_m:.1f} m ahead)"
            why = why if self.told else " (the camera has turned too little to tell)"
            return f"corrections of poses have no sure part in common in the camera's axes{why}; {single}"
        return (
            f"corrections of poses have in common {turned:.2f} degrees (+- {self.error_deg:.2f}) about "
            f"{_axes(self.rotation_deg, 2)} and {shifted:.1f} mm (+- {self.error_mm:.1f}), {_axes(self.shift_mm, 1)}, "
            f"in the camera's axes; {single}: if an arm or a tracker carries the camera, its hand-eye calibration is "
            "off"
        )


def constant_correction(given: Sequence[Array], corrected: Sequence[Array]) -> ConstantCorrection | None:
    """What corrections have in common; None for too few poses, or such as are not finite.

    given, corrected: (4, 4) each, camera to world, of the same captures in the order of time.
    """
    if len(given) < tuned.LEAST_POSES or not (np.isfinite(given).all() and np.isfinite(corrected).all()):
        return None
    whole = _Corrections.of(np.array(given), np.array(corrected))
    (rotation, shift), (left_rad, left_m) = whole.common()
    part = np.arange(len(given)) * tuned.PARTS // len(given)
    without = [whole.where(part != k).common()[0] for k in range(tuned.PARTS)]
    errors = [np.std([each[kind] for each in without], axis=0) * np.sqrt(tuned.PARTS - 1) for kind in range(2)]
    error_rad, error_m = (float(np.linalg.norm(error)) for error in errors)
    return ConstantCorrection(
        np.rad2deg(rotation),
        1e3 * shift,
        float(np.rad2deg(error_rad)),
        1e3 * error_m,
        float(np.rad2deg(_length(left_rad))),
        1e3 * _length(left_m),
        whole.told,
    )


@dataclass(frozen=True)
class _Corrections:
    """Of N poses: local (N, 3, 3), from the world's axes to the camera's; places (N, 3) in the world, meters; turned
    and shifted (N, 3), the corrections in the camera's axes, radians and meters."""

    local: Array
    places: Array
    turned: Array
    shifted: Array

    @staticmethod
    def of(given: Array, corrected: Array) -> _Corrections:
        local, places = given[:, :3, :3].transpose(0, 2, 1), given[:, :3, 3]
        turned = np.array([so3_log(to_camera @ pose[:3, :3]) for to_camera, pose in zip(local, corrected)])
        return _Corrections(local, places, turned, np.einsum("nij,nj->ni", local, corrected[:, :3, 3] - places))

    def where(self, chosen: NDArray[np.bool_]) -> _Corrections:
        return _Corrections(self.local[chosen], self.places[chosen], self.turned[chosen], self.shifted[chosen])

    def common(self) -> tuple[tuple[Array, Array], tuple[Array, Array]]:
        """The camera's rotation and shift (3,), and what is left of each pose (N, 3), of
        turned = c + R^T g and shifted = d + R^T (h + g x place)."""
        (camera, world), left_rad = self._solved(self.turned)
        shifted = self.shifted - np.einsum("nij,nj->ni", self.local, np.cross(world, self.places))
        (shift, _), left_m = self._solved(shifted)
        return (camera, shift), (left_rad, left_m)

    @property
    def told(self) -> bool:
        """Whether the camera has turned enough, about two axes, to tell its part from the world's."""
        mean = self.local.mean(axis=0)  # I - mean mean^T: the normal matrix of c that is left beside g, a pose
        return bool(np.linalg.eigvalsh(np.eye(3) - mean @ mean.T)[0] > tuned.TOLD)

    def _solved(self, found: Array) -> tuple[tuple[Array, Array], Array]:
        """The camera's and the world's part (3,) of ``found`` (N, 3), and the rest."""
        system = np.concatenate([np.broadcast_to(np.eye(3), self.local.shape), self.local], axis=2).reshape(-1, 6)
        prior = np.diag([tuned.COMMON_PRIOR * np.linalg.norm(system, 2)] * 3 + [0.0] * 3)
        solution, *_ = np.linalg.lstsq(np.vstack([system, prior]), np.append(found.ravel(), np.zeros(6)), rcond=None)
        return (solution[:3], solution[3:]), found - (system @ solution).reshape(-1, 3)


def _length(vectors: Array) -> float:
    return float(np.sqrt(np.square(vectors).sum(axis=1).mean()))


def _axes(vector: Array, digits: int) -> str:
    return "(" + ", ".join(f"{value:.{digits}f}" for value in vector) + ")"
