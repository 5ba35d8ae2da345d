"""A simulated arm with a camera over a target, with known truth: X is CAMERA_IN_FLANGE, Y TARGET_IN_BASE. Everything
is within half a meter of the base, as on the table of a UR3e. Samples of it, and pictures of its board."""

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND
from camera_node.robot.calibration.hand_eye.samples import Array, Rotation, Samples
from camera_node.robot.calibration.targets import GrayImage, Target, parse_target
from freshfield.geometry import Pinhole, look_at, se3, se3_inverse, so3_exp

# The arm's noise in the project's results.
ARM_RAD, ARM_M = 0.002, 0.0005
REACH_M = 0.5
# The target lies on the table with its pattern upwards, so its z points into the table.
CAMERA_IN_FLANGE = se3(so3_exp((0.02, -0.03, 1.55)), (0.055, -0.035, 0.045))
TARGET_IN_BASE = se3(so3_exp((np.pi, 0.0, 0.0)), (0.14, 0.02, 0.0))


def random_flanges(count: int, rng: np.random.Generator, tilt_deg: float = 50.0) -> Array:
    """Flanges in base (N, 4, 4), with the camera looking at the target from all sides and with any roll.
    tilt_deg: largest angle of view from the vertical."""
    out, middle = list[Array](), np.array([0.22, -0.04, 0.0])  # of the target
    while len(out) < count:
        azimuth, slope = rng.uniform(-np.pi, np.pi), np.deg2rad(tilt_deg) * np.sqrt(rng.uniform())
        to = [np.sin(slope) * np.cos(azimuth), np.sin(slope) * np.sin(azimuth), np.cos(slope)]
        camera = look_at(middle + rng.uniform(0.17, 0.30) * np.array(to), middle, up=(1.0, 0.0, 0.0))
        camera[:3, :3] = camera[:3, :3] @ so3_exp([0.0, 0.0, rng.uniform(-0.9, 0.9)])
        camera[:3, 3] += rng.normal(0.0, 0.01, 3)
        flange = camera @ se3_inverse(CAMERA_IN_FLANGE)
        if np.linalg.norm(flange[:3, 3]) < REACH_M:
            out.append(flange)
    return np.array(out)


def observed_targets(flanges: Array) -> Array:
    """Exact targets in camera (N, 4, 4)."""
    return np.asarray(se3_inverse(CAMERA_IN_FLANGE) @ se3_inverse(flanges) @ TARGET_IN_BASE)


def add_noise(poses: Array, rng: np.random.Generator, rad: float, meters: float) -> Array:
    """Poses with Gaussian noise: a rotation vector about the body's own axes, and a translation."""
    turns = Rotation.from_rotvec(rng.normal(0.0, rad, (len(poses), 3))).as_matrix()
    shifts = rng.normal(0.0, meters, (len(poses), 3))
    return se3(poses[:, :3, :3] @ turns, poses[:, :3, 3] + shifts)


BOARD = "charuco:7x5:24mm:18mm"
LENS = Pinhole.from_fov(320, 240, 65.0)


@lru_cache(maxsize=1)
def taken(count: int = 12) -> tuple[list[np.ndarray], np.ndarray]:
    """Gray pictures, and the flange's true poses (N, 4, 4)."""
    flanges = random_flanges(count, np.random.default_rng(3))
    board = parse_target(BOARD)
    return [photo(board, LENS, camera_in_target(h)) for h in flanges], flanges


def noisy_samples(
    count: int, rng: np.random.Generator, rad: float = ARM_RAD, meters: float = ARM_M, setup: str = EYE_IN_HAND
) -> Samples:
    """Samples with arm noise. For eye-to-hand, flange and base change places: X is the same (4, 4), then the
    camera in the base."""
    flanges = random_flanges(count, rng)
    targets = observed_targets(flanges)
    if setup != EYE_IN_HAND:
        flanges = se3_inverse(flanges)
    return Samples(add_noise(flanges, rng, rad, meters), targets, setup)


@lru_cache(maxsize=4)
def _fine_rays(lens: Pinhole) -> NDArray[np.float32]:
    return lens.scaled(2.0).rays().astype(np.float32)


def photo(target: Target, lens: Pinhole, camera_in_target: Array, noise: float = 0.0, seed: int = 0) -> GrayImage:
    """Gray picture (H, W) of the target on a white plate, on gray: where each pixel's ray meets its plane. Blank from
    behind, or along it."""
    if camera_in_target[2, 2] < 0.2:
        return np.full((lens.height, lens.width), 110, np.uint8)
    drawn = np.pad(target.draw(960 // target.modules * target.modules), 60, constant_values=255)
    pixel_m = target.size_m[0] / (drawn.shape[1] - 120)
    eye, turn = (camera_in_target[:3, 3] / pixel_m).astype(np.float32), camera_in_target[:3, :3].astype(np.float32)
    rays = cv2.transform(_fine_rays(lens), turn)
    at = eye[:2] - eye[2] / rays[..., 2:] * rays[..., :2] + np.float32(59.5)
    image = cv2.remap(drawn, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=110)
    image = cv2.resize(image, (lens.width, lens.height), interpolation=cv2.INTER_AREA).astype(np.float64)
    return np.clip(image + np.random.default_rng(seed).normal(0, noise, image.shape), 0, 255).astype(np.uint8)


def camera_in_target(flange: Array) -> Array:
    """(4, 4) of a flange in base."""
    return np.asarray(se3_inverse(TARGET_IN_BASE) @ flange @ CAMERA_IN_FLANGE)
