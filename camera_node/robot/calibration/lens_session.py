"""``camera-node calibrate intrinsics --live``: a guided session that says where to show the target next."""

from __future__ import annotations

import argparse
import contextlib

import numpy as np
from numpy.typing import NDArray

from camera_node.config import source_config
from camera_node.robot.calibration import CalibrationError, guided
from camera_node.robot.calibration.guided import KEPT, Step
from camera_node.robot.calibration.lens_calibration import (
    MIN_CORNERS,
    MIN_VIEWS,
    LensCalibration,
    calibrate_lens,
    coverage_grid,
)
from camera_node.robot.calibration.targets import Corners, Target, to_gray

GOOD_IMAGES, GOOD_COVERED, GOOD_TILT_DEG, GOOD_F = 10, 0.8, 30.0, 0.003
# Corner motion as a share of the image's width: the largest at rest, and the smallest that makes an image
# new.
STILL, NEW = 0.003, 0.06
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")


def calibrate_live(args: argparse.Namespace, board: Target) -> LensCalibration:
    """Run a session with a scenario's camera and calibrate from its images. Ctrl-C ends the session early.
    Raises CalibrationError, ScenarioError and CameraError."""
    loaded = guided.load_scenario(args)
    session = LensSession(board, args.moving)
    with contextlib.closing(guided.read_images(loaded, source_config(loaded), args)) as images:  # type: ignore[type-var]
        steps = ((image, session.corners, step) for image in images for step in [session.offer(image)])
        guided.guide(steps, args.preview)
    return session.lens()


class LensSession:
    """Collects at least 10 images that cover 0.8 of the image area, with the target tilted by 30 degrees
    between them, until the focal length is known to 0.3 %.

    moving: also take images while the target moves.
    corners: found in the last image.
    found: current calibration, if there is one.
    """

    def __init__(self, target: Target, moving: bool = False) -> None:
        self.corners: Corners | None = None
        self.found: LensCalibration | None = None
        self._target, self._moving = target, moving
        self._kept: dict[str, Corners] = {}
        self._size = (0, 0)
        self._why = ""
        self._cells = np.zeros((6, 6), dtype=np.bool_)

    def lens(self) -> LensCalibration:
        """Calibrate from all kept images. Raises CalibrationError."""
        return calibrate_lens(self._kept, self._size, {})

    def offer(self, image: NDArray[np.uint8]) -> Step:
        """Process an image (H, W) or (H, W, 3). Raises CalibrationError if its size differs from earlier
        ones."""
        size = image.shape[1], image.shape[0]
        if self._size not in ((0, 0), size):
            was = f"{self._size[0]} x {self._size[1]}"
            raise CalibrationError(f"a picture is {size[0]} x {size[1]}, those before were {was}")
        self._size = size
        last, self.corners = self.corners, self._target.find(to_gray(image))
        if self.corners is None:
            return self._step("target not found", "bring all of it into the picture, well lit")
        if len(self.corners.points) < MIN_CORNERS:
            return self._step("target unclear", "show more of it")
        if not self._moving and (last is None or _distance(last, self.corners) > STILL * size[0]):
            return self._step("moving", "hold still")
        alike = [name for name, kept in self._kept.items() if _distance(kept, self.corners) < NEW * size[0]]
        if alike:
            return self._step(f"like {alike[0]}")
        self._kept[f"picture {len(self._kept) + 1}"] = self.corners
        self._cells = coverage_grid(self._kept.values(), size)
        try:
            self.found, self._why = self.lens(), ""
        except CalibrationError as error:
            self.found, self._why = None, str(error)
        return self._step(KEPT)

    def _step(self, outcome: str, advice: str | None = None) -> Step:
        progress = f"{len(self._kept)} pictures, {100 * self._cells.mean():.0f} % of the picture covered"
        if self.found is not None:
            progress += (
                f", tilted by {self.found.tilt_deg:.0f} degrees, f {self.found.pinhole.fx:.1f} +- "
                f"{self.found.std[0]:.1f} px, reprojection {self.found.error_px:.2f} px"
            )
        enough = self._missing() is None
        return Step(outcome, progress, enough, advice or self._missing() or "enough")

    def _missing(self) -> str | None:
        """What to do next; None if there is enough."""
        lens = self.found
        if self._cells.mean() < GOOD_COVERED:
            # 3 x 3 parts of 2 x 2 cells each: the emptiest first.
            parts = self._cells.reshape(3, 2, 3, 2).sum(axis=(1, 3))
            row, column = divmod(int(np.argmin(parts)), 3)
            where = "middle" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"
            return f"show it at the {where} of the picture, also tilted"
        if lens is None:
            return self._why if len(self._kept) >= MIN_VIEWS else "show it elsewhere, also tilted"
        if lens.tilt_deg < GOOD_TILT_DEG:
            return "tilt it more, about different axes"
        if len(lens.views) < GOOD_IMAGES or lens.std[0] > GOOD_F * lens.pinhole.fx:
            return "go on, nearer and tilted, everywhere"
        return None


def _distance(a: Corners, b: Corners) -> float:
    """Mean distance (pixels) of the common corners; infinite if these are less than half."""
    at = dict(zip(map(tuple, a.points.tolist()), a.pixels))
    pairs = [(at[key], pixel) for key, pixel in zip(map(tuple, b.points.tolist()), b.pixels) if key in at]
    if 2 * len(pairs) < max(len(a.points), len(b.points)):
        return float("inf")
    one, other = np.array(pairs).swapaxes(0, 1)
    return float(np.linalg.norm(one - other, axis=1).mean())
