"""A camera's lens and its uncertainty from images of a target (Zhang's method, OpenCV's solver)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration import calibration_constants as tuned
from camera_node.robot.calibration.hand_eye.samples import Array
from camera_node.robot.calibration.targets import Corners
from camera_node.sources.calibration_file import calibration_entry
from freshfield.geometry import Pinhole

_UNDETERMINED = "the pictures do not determine a lens: show the target larger, tilted, everywhere"


@dataclass(frozen=True)
class LensCalibration:
    """Result of a lens calibration.

    pinhole: in this project's convention (corner origin).
    std: deviations of fx, fy, cx, cy (pixels), k1, k2, p1, p2.
    error_px: root mean square of the reprojection errors; views: the same by image.
    tilt_deg: largest angle between the target's tilts in two views.
    covered: share of a 6 x 6 grid over the image in which corners were seen.
    unused: reason for every unused image.
    """

    pinhole: Pinhole
    std: tuple[float, ...]
    error_px: float
    views: Mapping[str, float]
    tilt_deg: float
    covered: float
    unused: Mapping[str, str]

    def to_json(self, camera: str) -> dict[str, Any]:
        """The calibration JSON that the video source and --lens read."""
        known = {"error_px": self.error_px, "std_fx_fy_cx_cy_k1_k2_p1_p2": list(self.std)}
        return {camera: calibration_entry(self.pinhole) | known}

    def show(self) -> str:
        p, s = self.pinhole, self.std
        lines = [
            f"{len(self.views)} pictures of {p.width} x {p.height}; reprojection {self.error_px:.3f} px; "
            f"the target tilted by up to {self.tilt_deg:.0f} degrees between them; corners over "
            f"{100 * self.covered:.0f} % of the picture",
            f"fx {p.fx:.2f} +- {s[0]:.2f}  fy {p.fy:.2f} +- {s[1]:.2f}  cx {p.cx:.2f} +- {s[2]:.2f}  "
            f"cy {p.cy:.2f} +- {s[3]:.2f} px (corner origin)",
            "k1 {:.4f} +- {:.4f}  k2 {:.4f} +- {:.4f}  p1 {:.5f} +- {:.5f}  p2 {:.5f} +- {:.5f}".format(
                *(v for pair in zip(p.distortion, s[4:]) for v in pair)
            ),
            *(f"note: {name}: {why}" for name, why in self.unused.items()),
        ]
        if self.covered < 0.5:
            lines.append("note: less than half of the picture was covered: distortion is guessed elsewhere")
        return "\n".join(lines)


def calibrate_lens(views: Mapping[str, Corners], size: tuple[int, int], unused: Mapping[str, str]) -> LensCalibration:
    """Calibrate from corners by image name.

    size: width and height of the images in pixels.
    unused: reasons for images without corners.
    Raises CalibrationError if the corners do not determine a lens.
    """
    usable = {name: c for name, c in views.items() if len(c.points) >= tuned.MIN_CORNERS}
    unused = {**unused, **{name: f"only {len(c.points)} corners" for name, c in views.items() if name not in usable}}
    if len(usable) < tuned.MIN_VIEWS:
        why = next((f"; {name}: {each}" for name, each in unused.items()), "")
        raise CalibrationError(
            f"too few pictures show the target: {len(usable)} of {len(usable) + len(unused)}, "
            f"at least {tuned.MIN_VIEWS} are needed and 10 to 20 are good{why}"
        )
    lens, std, normals, errors = _solve(usable, size)
    limit = tuned.OUTLIER_ERROR * float(np.median(errors))
    bad = [name for name, error in zip(usable, errors) if error > limit]
    if bad and len(usable) - len(bad) >= tuned.MIN_VIEWS:
        unused = {**unused, **{name: "does not fit the others, left out" for name in bad}}
        usable = {name: c for name, c in usable.items() if name not in bad}
        lens, std, normals, errors = _solve(usable, size)
    possible = all(tuned.SHORTEST_FOCAL < f / max(size) < tuned.LONGEST_FOCAL for f in (lens.fx, lens.fy))
    if not (
        np.isfinite([lens.fx, lens.fy, *lens.distortion, *std]).all()
        and possible
        and std[0] < tuned.LARGEST_FOCAL_STD * lens.fx
    ):
        raise CalibrationError(_UNDETERMINED)
    tilt_deg = float(np.degrees(np.arccos(np.clip((normals @ normals.T).min(), -1.0, 1.0))))
    if tilt_deg < tuned.MIN_TILT_DEG:
        raise CalibrationError(
            f"the target was held the same way in all pictures (tilts differ by {tilt_deg:.1f} degrees, at "
            f"least {tuned.MIN_TILT_DEG:g} are needed): focal length and distance cannot be told apart; tilt it"
        )
    counts = [len(c.points) for c in usable.values()]
    error_px = float(np.sqrt(np.average(np.square(errors), weights=counts)))
    cells = [
        np.clip(c.pixels / size * tuned.COVERED_CELLS, 0, tuned.COVERED_CELLS - 1).astype(int) for c in usable.values()
    ]
    covered = len(np.unique(np.concatenate(cells), axis=0)) / tuned.COVERED_CELLS**2
    found = dict(zip(usable, errors.tolist()))
    return LensCalibration(lens, std, error_px, found, tilt_deg, covered, unused)


def _solve(views: Mapping[str, Corners], size: tuple[int, int]) -> tuple[Pinhole, tuple[float, ...], Array, Array]:
    """Lens, its deviations, the target's normals (V, 3) in camera axes, and the reprojection errors (V,)."""
    points = [c.points.astype(np.float32) for c in views.values()]
    # OpenCV's origin is the center of the first pixel.
    pixels = [(c.pixels - 0.5).astype(np.float32) for c in views.values()]
    try:
        _, matrix, distortion, turns, _, std, _, errors = cv2.calibrateCameraExtended(
            points, pixels, size, np.eye(3), np.zeros(4), flags=cv2.CALIB_FIX_K3
        )
    except cv2.error as error:
        raise CalibrationError(f"{_UNDETERMINED} ({error.err})") from None
    lens = Pinhole.from_opencv(*size, matrix, distortion.ravel()[:4])
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    return lens, tuple(map(float, std.ravel()[:8])), normals, np.asarray(errors, dtype=np.float64).ravel()
