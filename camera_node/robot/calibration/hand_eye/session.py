"""A guided hand-eye calibration: collects images and hand poses, and tells what to do next and when to stop.
The caller provides camera, arm and clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration import WANT_MM, CalibrationError
from camera_node.robot.calibration.files import to_samples
from camera_node.robot.calibration.hand_eye.calibrate import angle_deg, distance_mm
from camera_node.robot.calibration.hand_eye.joint_refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Diversity,
    Samples,
    angles,
    diversity,
    rotation_vectors,
)
from camera_node.robot.calibration.targets import Corners, Target, TargetPose, estimate_pose, to_gray
from freshfield.geometry import Pinhole

MIN_POSES, GOOD_SPREAD_DEG = 10, 15.0
# A pose rotated by less from a kept one adds little information.
NEW_DEG = 8.0
# Largest motion between two frames at rest: for more, stamps that are a few milliseconds off would matter.
STILL_MM, STILL_DEG = 0.5, 0.1
_MIN_TO_SOLVE = 4
KEPT, MOVING = "kept", "hand moving"


@dataclass(frozen=True)
class HandEyeStep:
    """Result of one image.

    outcome: ``kept``, or why not.
    count: number of samples kept.
    std_mm, std_deg: standard deviations of the current calibration, if there is one.
    enough: whether to stop.
    advice: what to do next.
    """

    outcome: str
    count: int
    diversity: Diversity
    std_mm: float | None
    std_deg: float | None
    enough: bool
    advice: str

    @property
    def line(self) -> str:
        sure = "" if self.std_mm is None else f", sure to {self.std_mm:.2f} mm {self.std_deg:.3f} degrees"
        spread = f"axes spread by {self.diversity.axis_spread_deg:.0f} degrees"
        return f"{self.count} poses, {spread}{sure}; {self.outcome}: {self.advice}"


class HandEyeSession:
    """Collects samples until the standard deviation of the translation is at most ``want_mm``.

    moving: also take images while the hand moves; its poses must then be exact in time.
    before: samples of an earlier session to continue.
    kept: called with all samples after each new one.
    """

    def __init__(
        self,
        target: Target,
        setup: str,
        want_mm: float = WANT_MM,
        moving: bool = False,
        before: Samples | None = None,
        kept: Callable[[Samples], None] = lambda samples: None,
    ) -> None:
        self._target, self._setup, self._want_mm, self._moving = target, setup, want_mm, moving
        self._before, self._kept = before, kept
        self._seen: list[TargetPose] = []
        self._hands: list[Array] = []
        self._last: Array | None = None
        self._refined: Refinement | None = None
        self._diversity = diversity(self.samples())
        self.corners: Corners | None = None
        """Found in the last image."""
        self.seen: TargetPose | None = None
        """The target in the last image, if its pose could be estimated."""
        self._solve()

    def samples(self) -> Samples:
        """All kept samples, with the target's covariance unless some are from an earlier session."""
        names = [f"pose {k + 1}" for k in range(len(self._seen))]
        new = to_samples(self._seen, self._hands, names, self._setup)
        if self._before is None:
            return new
        hand = np.concatenate([self._before.hand, new.hand])
        target = np.concatenate([self._before.target, new.target])
        return Samples(hand, target, self._setup)

    def offer(self, image: NDArray[np.uint8], lens: Pinhole, hand: Array) -> HandEyeStep:
        """Process an image (H, W, 3) taken with the hand at ``hand`` (4, 4), in base."""
        last, self._last = self._last, hand
        self.corners = self.seen = None
        if not self._moving and (last is None or _motion(last, hand) > 1.0):
            return self._step(MOVING, "hold still")
        self.corners = self._target.find(to_gray(image))
        if self.corners is None:
            return self._step("target not found", "bring all of it into the picture, well lit")
        try:
            self.seen = seen = estimate_pose(self.corners, lens)
        except CalibrationError as error:
            return self._step("target unclear", str(error))
        like = self._nearest_kept(hand)
        if like is not None:
            return self._step(f"like pose {like + 1}", self._advice())
        self._seen.append(seen)
        self._hands.append(hand)
        self._diversity = diversity(self.samples())
        self._solve()
        self._kept(self.samples())
        return self._step(KEPT, self._advice())

    def _solve(self) -> None:
        samples = self.samples()
        self._refined = None
        if self._diversity.reason is None and len(samples) >= _MIN_TO_SOLVE:
            self._refined = refine(samples)

    def _nearest_kept(self, hand: Array) -> int | None:
        hands = self.samples().hand
        if not len(hands):
            return None
        turned_deg = np.degrees(angles(np.swapaxes(hands[:, :3, :3], 1, 2) @ hand[:3, :3]))
        nearest = int(np.argmin(turned_deg))
        return nearest if turned_deg[nearest] < NEW_DEG else None

    @property
    def _enough(self) -> bool:
        return (
            self._refined is not None
            and len(self._hands) + (0 if self._before is None else len(self._before)) >= MIN_POSES
            and self._diversity.axis_spread_deg >= GOOD_SPREAD_DEG
            and self._refined.std_mm <= self._want_mm
        )

    def _advice(self) -> str:
        if self._enough:
            return "enough"
        return missing_turn(self.samples().hand)

    def _step(self, outcome: str, advice: str) -> HandEyeStep:
        found = self._refined
        return HandEyeStep(
            outcome,
            len(self.samples()),
            self._diversity,
            None if found is None else found.std_mm,
            None if found is None else found.std_deg,
            self._enough,
            advice,
        )


def missing_turn(hands: Array) -> str:
    """Instruction to an operator: the axis about which poses (N, 4, 4) differ least from the first."""
    if not len(hands):
        return "bring the target into the picture"
    turns = rotation_vectors(hands[0, :3, :3].T @ hands[:, :3, :3])
    axis = int(np.argmin((turns**2).sum(axis=0)))
    sign = "-" if turns[:, axis].sum() > 0 else "+"
    return f"turn the flange by 20 to 40 degrees about its {sign}{'xyz'[axis]}, the target in sight"


def preview(image: NDArray[np.uint8], corners: Corners | None, step: HandEyeStep) -> NDArray[np.uint8]:
    """The image as (H + 40, W, 3) RGB, with the corners that were found, and the step below it."""
    lines = f"{step.count} poses", f"{step.outcome}: {step.advice}"
    return draw_corners(to_gray(image), corners, lines, step.outcome == KEPT)


def draw_corners(
    plain: NDArray[np.uint8], corners: Corners | None, lines: tuple[str, str], kept: bool
) -> NDArray[np.uint8]:
    """A gray image as (H + 40, W, 3) RGB, with circles at its corners and two lines of text below it."""
    out = np.zeros((plain.shape[0] + 40, max(plain.shape[1], 320), 3), dtype=np.uint8)
    out[: plain.shape[0], : plain.shape[1]] = plain[..., None]
    if corners is not None:
        for x, y in corners.pixels:
            cv2.circle(out, (round(x - 0.5), round(y - 0.5)), 4, (0, 158, 115), 1, cv2.LINE_AA)
    color = (0, 158, 115) if kept else (213, 94, 0)
    for line, text in enumerate(lines):
        at = (6, plain.shape[0] + 15 + 17 * line)
        cv2.putText(out, text, at, cv2.FONT_HERSHEY_SIMPLEX, 0.4, color, 1, cv2.LINE_AA)
    return out


def _motion(a: Array, b: Array) -> float:
    """Motion between two hand poses, as a multiple of the largest that counts as at rest."""
    return max(distance_mm(a, b) / STILL_MM, angle_deg(a, b) / STILL_DEG)
