"""A guided calibration of a lens: collects images, and tells where to show the target next and when to stop.
The caller provides camera and clock."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.hand_eye.session import KEPT, draw_corners
from camera_node.robot.calibration.lens.solve import MIN_CORNERS, MIN_VIEWS, LensCalibration, calibrate, coverage_grid
from camera_node.robot.calibration.targets import Corners, Target, to_gray

GOOD_PICTURES, GOOD_COVERED, GOOD_TILT_DEG, GOOD_F = 10, 0.8, 30.0, 0.003
# Corner motion as a share of the image's width: the largest at rest, and the smallest that makes an image
# new.
STILL, NEW = 0.003, 0.06
_ROWS, _COLUMNS = ("top", "middle", "bottom"), ("left", "middle", "right")


@dataclass(frozen=True)
class LensStep:
    """Result of one image.

    outcome: ``kept``, or why not.
    count: number of images kept.
    covered: share of the image area in which corners were seen.
    lens: current calibration, if there is one.
    enough: whether to stop.
    advice: what to do next.
    """

    outcome: str
    count: int
    covered: float
    lens: LensCalibration | None
    enough: bool
    advice: str

    @property
    def line(self) -> str:
        found = ""
        if self.lens is not None:
            p = self.lens.pinhole
            found = (
                f", tilted by {self.lens.tilt_deg:.0f} degrees, f {p.fx:.1f} +- {self.lens.std[0]:.1f} px, "
                f"reprojection {self.lens.error_px:.2f} px"
            )
        return (
            f"{self.count} pictures, {100 * self.covered:.0f} % of the picture covered{found}; "
            f"{self.outcome}: {self.advice}"
        )


class LensSession:
    """Collects at least 10 images that cover 0.8 of the image area, with the target tilted by 30 degrees
    between them, until the focal length is known to 0.3 %. moving: also take images during motion."""

    def __init__(self, target: Target, moving: bool = False) -> None:
        self._target, self._moving = target, moving
        self._kept: dict[str, Corners] = {}
        self._size = (0, 0)
        self._lens: LensCalibration | None = None
        self._why = ""
        self._cells = np.zeros((6, 6), dtype=np.bool_)
        self.corners: Corners | None = None
        """Found in the last image."""

    def lens(self) -> LensCalibration:
        """Calibrate from all kept images. Raises CalibrationError."""
        return calibrate(self._kept, self._size, {})

    def offer(self, image: NDArray[np.uint8]) -> LensStep:
        """Process an image (H, W) or (H, W, 3). Raises CalibrationError if its size differs from earlier
        ones."""
        size = image.shape[1], image.shape[0]
        if self._size not in ((0, 0), size):
            was = f"{self._size[0]} x {self._size[1]}"
            raise CalibrationError(f"a picture is {size[0]} x {size[1]}, those before were {was}")
        self._size = size
        last = self.corners
        self.corners = self._target.find(to_gray(image))
        if self.corners is None:
            return self._step("target not found", "bring all of it into the picture, well lit")
        if len(self.corners.points) < MIN_CORNERS:
            return self._step("target unclear", "show more of it")
        if not self._moving and (last is None or _distance(last, self.corners) > STILL * size[0]):
            return self._step("moving", "hold still")
        alike = [name for name, kept in self._kept.items() if _distance(kept, self.corners) < NEW * size[0]]
        if alike:
            return self._step(f"like {alike[0]}", self._advice())
        self._kept[f"picture {len(self._kept) + 1}"] = self.corners
        self._cells = coverage_grid(self._kept.values(), size)
        try:
            self._lens, self._why = self.lens(), ""
        except CalibrationError as error:
            self._lens, self._why = None, str(error)
        return self._step(KEPT, self._advice())

    def preview(self, image: NDArray[np.uint8], step: LensStep) -> NDArray[np.uint8]:
        """The image as (H + 40, W, 3) RGB, with its corners, dots at earlier corners, and the step below
        it."""
        lines = f"{step.count} pictures, {100 * step.covered:.0f} % covered", f"{step.outcome}: {step.advice}"
        shown = to_gray(image).copy()
        for kept in self._kept.values():
            for x, y in kept.pixels:
                cv2.circle(shown, (round(x - 0.5), round(y - 0.5)), 2, 255, -1)
        return draw_corners(shown, self.corners, lines, step.outcome == KEPT)

    @property
    def _enough(self) -> bool:
        lens = self._lens
        return (
            lens is not None
            and len(lens.views) >= GOOD_PICTURES
            and self._covered >= GOOD_COVERED
            and lens.tilt_deg >= GOOD_TILT_DEG
            and lens.std[0] <= GOOD_F * lens.pinhole.fx
        )

    @property
    def _covered(self) -> float:
        return float(self._cells.mean())

    def _advice(self) -> str:
        if self._enough:
            return "enough"
        if self._covered < GOOD_COVERED:
            # 3 x 3 parts of 2 x 2 cells each: the emptiest first.
            parts = self._cells.reshape(3, 2, 3, 2).sum(axis=(1, 3))
            row, column = divmod(int(np.argmin(parts)), 3)
            where = "middle" if row == column == 1 else f"{_ROWS[row]} {_COLUMNS[column]}"
            return f"show it at the {where} of the picture, also tilted"
        if self._lens is None:
            return self._why if len(self._kept) >= MIN_VIEWS else "show it elsewhere, also tilted"
        if self._lens.tilt_deg < GOOD_TILT_DEG:
            return "tilt it more, about different axes"
        return "go on, nearer and tilted, everywhere"

    def _step(self, outcome: str, advice: str) -> LensStep:
        return LensStep(outcome, len(self._kept), self._covered, self._lens, self._enough, advice)


def _distance(a: Corners, b: Corners) -> float:
    """Mean distance (pixels) of the common corners; infinite if these are less than half."""
    at = dict(zip(map(tuple, a.points.tolist()), a.pixels))
    pairs = [(at[key], pixel) for key, pixel in zip(map(tuple, b.points.tolist()), b.pixels) if key in at]
    if 2 * len(pairs) < max(len(a.points), len(b.points)):
        return float("inf")
    one, other = np.array(pairs).swapaxes(0, 1)
    return float(np.linalg.norm(one - other, axis=1).mean())
