"""Detect what changed, beyond noise, between the last two frames of a camera that stood still."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.moving_pixels import BOUND, pair_noise
from edge_server.fields import View

# In standard deviations of one blurred frame's noise: 4.2 of a difference of two. Of 27,000 pixels of three
# channels, two pass by chance, and these are isolated (see _SUPPORT).
NOISE_SIGMAS = 6.0
_NOISE_LIMIT = 0.05  # where differences seem noisier, nearly the whole image moves
_SUPPORT = 5  # changed pixels needed among the 3 x 3 around a changed one
_LEAST_SHARE = 6e-4  # of an image: smaller patches of changed pixels are noise that happened to touch


@dataclass(frozen=True)
class Changes:
    """Comparison of two frames of one camera.

    changed: bool (H, W).
    bound: difference in [0, 1] above which the blurred frames count as changed.
    gap_ms: time between the two.
    """

    changed: NDArray[np.bool_]
    bound: float
    gap_ms: float


def blurred(image: NDArray[np.uint8]) -> NDArray[np.float32]:
    """float32 (H, W, C) in [0, 1]: the mean of the 3 x 3 pixels around each."""
    soft: NDArray[np.float32] = np.asarray(
        cv2.blur(image.astype(np.float32) / np.float32(255.0), (3, 3)), dtype=np.float32
    )
    return soft


def difference(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32 (H, W): the largest difference of two images (H, W, C) over the channels."""
    most: NDArray[np.float32] = np.abs(a - b).max(axis=2)
    return most


def compare(before: View, now: View) -> Changes | None:
    """What changed between two views of a camera. None where the camera itself may have caused the change: it
    moved, its lens or image size changed, or ``now`` was not taken after ``before``."""
    gap_ms = (now.generated_ns - before.generated_ns) / 1e6
    if gap_ms <= 0.0 or before.image.shape != now.image.shape or before.intrinsics != now.intrinsics:
        return None
    if not np.allclose(before.camera_to_world, now.camera_to_world, atol=1e-6):
        return None
    a, b = blurred(before.image), blurred(now.image)
    # How much noise remains after blurring depends on its grain, which is coarse in denoised renderings and
    # compressed video. So it is measured on the blurred frames.
    sigma = pair_noise(a[..., :3].astype(np.float64), b[..., :3].astype(np.float64))
    bound = max(BOUND, NOISE_SIGMAS * min(sigma or 0.0, _NOISE_LIMIT))
    return Changes(without_specks(difference(a, b) > bound), bound, gap_ms)


@dataclass(frozen=True)
class AgedView:
    """A view, the one before of its camera, its age, and the age up to which views count as young."""

    view: View
    before: View | None
    age_ms: float
    young_ms: float


def with_ages(views: Sequence[View], earlier: Mapping[str, View], now_ns: int, young: float) -> list[AgedView]:
    """The views in their order, with their ages at ``now_ns``. young: share of them, youngest first, that
    count as young."""
    ages_ms = [(now_ns - view.generated_ns) / 1e6 for view in views]
    young_ms = young_age_ms(ages_ms, young)
    return [AgedView(view, earlier.get(view.camera), age, young_ms) for view, age in zip(views, ages_ms)]


def young_age_ms(ages_ms: Sequence[float], share: float) -> float:
    """The age that the youngest ``share`` of the views (one at least) do not exceed, 0 at least."""
    if not ages_ms:
        return 0.0
    return max(sorted(ages_ms)[max(int(np.ceil(share * len(ages_ms))), 1) - 1], 0.0)


def without_specks(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """The mask without nearly isolated pixels and without small patches."""
    if not mask.any():
        return mask
    bits = mask.astype(np.uint8)
    support = cv2.boxFilter(bits, cv2.CV_16S, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)
    core = (mask & (support >= _SUPPORT)).astype(np.uint8)
    _, label, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] >= max(_LEAST_SHARE * mask.size, 4.0)
    large[0] = False
    # Pixels that support a patch belong to it.
    near = cv2.dilate(large[label].astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool)
    return mask & near


def dilated(mask: NDArray[np.bool_], by_px: float) -> NDArray[np.bool_]:
    """The mask (H, W) dilated with a disk of radius ``by_px``, at most over the whole image."""
    margin = int(min(np.ceil(by_px), max(mask.shape)))
    if margin < 1 or not mask.any():
        return mask
    disk = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * margin + 1, 2 * margin + 1))
    return cv2.dilate(mask.astype(np.uint8), disk).astype(bool)
