"""Input of calibrations with known truth: rendered images of a ChArUco board, and samples."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from scipy.ndimage import map_coordinates

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
from camera_node.robot.calibration.hand_eye.samples import Array, Samples
from camera_node.robot.calibration.targets import GrayImage, Target, parse_target
from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import Part
from camera_node.synthetic.render import CameraRenderer, World
from camera_node.synthetic.shapes import Quad
from camera_node.synthetic.textures import Plain
from freshfield.geometry import Pinhole, se3, se3_inverse, so3_exp
from tests.camera_node.robot.calibration import known_truth

BOARD = "charuco:7x5:24mm:18mm"
LENS = Pinhole.from_fov(320, 240, 65.0)
_PLATE_MARGIN_M = 0.02


@lru_cache(maxsize=1)
def taken(count: int = 12) -> tuple[list[np.ndarray], np.ndarray]:
    """Gray pictures, and the flange's true poses (N, 4, 4)."""
    flanges = known_truth.random_flanges(count, np.random.default_rng(3))
    board = parse_target(BOARD)
    return [render(board, LENS, camera_in_target(h), 2) for h in flanges], flanges


def noisy_samples(
    count: int,
    rng: np.random.Generator,
    rad: float = known_truth.ARM_RAD,
    meters: float = known_truth.ARM_M,
    setup: str = EYE_IN_HAND,
) -> Samples:
    """Samples with arm noise. For eye-to-hand, flange and base change places: X is the same (4, 4), then the
    camera in the base."""
    flanges = known_truth.random_flanges(count, rng)
    targets = known_truth.observed_targets(flanges)
    if setup != EYE_IN_HAND:
        flanges = se3_inverse(flanges)
    return Samples(known_truth.add_noise(flanges, rng, rad, meters), targets, setup)


def render(target: Target, lens: Pinhole, camera_in_target: Array, supersample: int = 3) -> GrayImage:
    """Render (H, W) the target on a white plate on a table, by the project's ray caster."""
    width, height = target.size_m
    picture = target.draw(max(256, round(width / 0.0002)))
    # The caster's rectangle is seen from +z and has y up; a target's z goes into the paper and its y down.
    flip = se3(so3_exp((np.pi, 0.0, 0.0)), np.array([width / 2, height / 2, 0.0]))
    parts = []
    for depth_m, margin_m, texture in (
        (0.0, 0.0, _ImageTexture(picture, width, height)),
        (0.0005, _PLATE_MARGIN_M, Plain((0.95, 0.95, 0.95))),
        (0.001, 0.6, Plain((0.45, 0.42, 0.40))),
    ):
        below = flip.copy()
        below[2, 3] = depth_m
        parts.append(Part(Quad((width / 2 + margin_m, height / 2 + margin_m)), texture, below, False))
    lamp = (width / 2, height / 2, -1.0)
    light = Light(np.array([lamp]), 0.2, 2.0, (0.7, 0.7, 0.7), (0.7, 0.7, 0.7), (1.0, 1.0, 1.0))
    world = World(tuple(parts), (), light, (0.5, 0.5, 0.5))
    image = CameraRenderer(world, lens, camera_in_target, supersample).image(0.0)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), dtype=np.uint8)


def camera_in_target(flange: Array) -> Array:
    """(4, 4) for ``render``, of a flange in base."""
    return np.asarray(se3_inverse(known_truth.TARGET_IN_BASE) @ flange @ known_truth.CAMERA_IN_FLANGE)


@dataclass(frozen=True)
class _ImageTexture:
    """Texture of a gray image on a rectangle, with linear interpolation."""

    pixels: GrayImage
    width_m: float
    height_m: float

    def __call__(self, uv: Array) -> Array:
        rows, columns = self.pixels.shape
        x = (uv[0] / self.width_m + 0.5) * columns - 0.5
        y = (0.5 - uv[1] / self.height_m) * rows - 0.5
        gray = map_coordinates(self.pixels.astype(np.float32), [y, x], order=1, mode="nearest")
        return np.repeat(gray[None] / 255.0, 3, axis=0)
