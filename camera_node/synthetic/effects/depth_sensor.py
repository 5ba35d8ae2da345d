"""Depth sensor: each camera also measures depth, with the errors of an active stereo sensor.

A stereo sensor measures disparity d = focal length * baseline / depth, so its errors are errors of d and grow with the
square of depth. Depth is registered to the image. If poses of cameras shall be wrong too, list ``pose_noise``:
``{translation_mm: 0, rotation_deg: 0, translation_bias_mm: 1.7, rotation_bias_deg: 0.12}`` is a calibration that is off
by 3 mm and .2 degrees (root mean square of the three axes together).
"""

from __future__ import annotations

from typing import Annotated, ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.effects import EffectParameters, frame_rng
from camera_node.synthetic.render import Image
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole
from freshfield.settings import about, within

# Of the Intel RealSense D435: 848 pixels over 90 degrees (Intel, "Subpixel Linearity Improvement for RealSense D400"),
# and 50 mm between its imagers (data sheet).
FOCAL_PX = 425.0
BASELINE_M = 0.05
METERS_PER_COUNT = 0.001
# A silhouette is where disparity departs by this much, in the sensor's pixels, from that of a plane. The window that a
# stereo sensor matches spans both surfaces there. The value has no source: smooth surfaces stay below it.
_JUMP_PX = 0.6
_FIXED = 2**63  # number of the fixed noise's stream: frames have smaller ones
_SECOND_DIFFERENCE = np.array([1.0, -2.0, 1.0], dtype=np.float32)
_NEIGHBORS = np.ones((3, 3), dtype=np.uint8)

Share = Annotated[float, within(0.0, 1.0, "share of the pixels")]


class DepthSensor(EffectParameters, frozen=True):
    """Whole millimeters from a sensor of 425 px focal length and 50 mm baseline (Intel RealSense D435 at 848 x 480).

    The steps of 1/32 px are Intel's ("Subpixel Linearity Improvement for RealSense D400"), the range is near what the
    D435's data sheet gives; the other defaults are plausible and have no published source. Noise, in pixels of the
    sensor, is the standard deviation after smoothing. Silhouettes are pixels beside a jump of depth; with the defaults
    2 % of the pixels of ``room`` at 128 x 128 fly. Gray values are the image's. All errors at 0 give exact depth.
    """

    noise_px: Annotated[float, within(0.0, 100.0, "disparity noise, new in each frame")] = 0.08
    fixed_noise_px: Annotated[float, within(0.0, 100.0, "disparity noise of each pixel that stays")] = 0.06
    smoothing_px: Annotated[float, within(0.0, 10.0, "sigma of the Gaussian that correlates both")] = 2.3
    step_px: Annotated[float, within(0.0, 100.0, "disparity is a multiple of it; 0: continuous")] = 1 / 32
    scale_spread_percent: Annotated[float, within(0.0, 20.0, "standard deviation of a camera's scale error")] = 0.5
    nearest_m: Annotated[float, within(0.0, 1e3, "nothing nearer is measured")] = 0.3
    farthest_m: Annotated[float, within(0.0, 65.535, "nothing farther is measured")] = 8.0
    shadow: Annotated[bool, about("nothing is measured where the second imager, to the right, sees less")] = True
    silhouette_holes: Annotated[Share, about("of silhouettes without depth, new in each frame")] = 0.3
    flying: Annotated[Share, about("of silhouettes with a depth between both surfaces, new in each frame")] = 0.5
    dark_below: Annotated[int, within(0, 256, "gray value of 255 below which a pixel is dark")] = 25
    dark_holes: Annotated[Share, about("of dark pixels without depth, always the same")] = 0.7
    bright_above: Annotated[int, within(0, 256, "gray value above which a pixel is overexposed")] = 250
    bright_holes: Annotated[Share, about("of overexposed pixels without depth, always the same")] = 0.5

    kind: ClassVar[str] = "depth"

    def start(self, rng: np.random.Generator) -> StereoDepth:
        return StereoDepth(self, rng)


class StereoDepth:
    """One camera's depth sensor; a measurement depends only on the camera's random stream and the frame's number.

    scale: factor by which it errs.
    """

    def __init__(self, parameters: DepthSensor, rng: np.random.Generator) -> None:
        self._p = parameters
        self._key = rng.integers(0, 2**64, size=2, dtype=np.uint64)
        self.scale = 1.0 + 0.01 * parameters.scale_spread_percent * float(np.clip(rng.standard_normal(), -4, 4))
        self._fixed: dict[tuple[int, int, float], tuple[NDArray[np.float32], NDArray[np.float32]]] = {}

    def measure(self, depth_m: NDArray[np.float32], image: Image, camera: Pinhole, index: int) -> DepthImage:
        """See ``DepthEffect``."""
        p, rng = self._p, frame_rng(self._key, index)
        hit = depth_m > 0.0
        inverse = np.divide(1.0, depth_m, out=np.zeros_like(depth_m), where=hit)
        noise, luck = self._fixed_of(depth_m.shape, camera.fx)
        hole = ~hit | self._unmatched(image, luck)
        if p.shadow:
            hole |= _second_imager_misses(inverse, camera.fx * BASELINE_M)
        if p.silhouette_holes or p.flying:
            inverse = self._silhouettes(inverse, hole, rng)
        if p.noise_px or p.fixed_noise_px or p.step_px:
            disparity: NDArray[np.float32] = np.float32(FOCAL_PX * BASELINE_M) * inverse + noise
            if p.noise_px:
                disparity += self._noise(rng, depth_m.shape, camera.fx, p.noise_px)
            if p.step_px:
                disparity /= np.float32(p.step_px)
                np.rint(disparity, out=disparity)
                disparity *= np.float32(p.step_px)
            inverse = disparity * np.float32(1.0 / (FOCAL_PX * BASELINE_M))
        hole |= inverse <= 0.0
        measured = np.divide(self.scale, inverse, out=np.zeros_like(depth_m), where=~hole)
        hole |= (measured < p.nearest_m) | (measured > p.farthest_m)
        counts = np.rint(np.where(hole, 0.0, measured) / METERS_PER_COUNT).astype(np.uint16)
        return DepthImage(counts, METERS_PER_COUNT)

    def _fixed_of(self, shape: tuple[int, ...], fx: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Fixed disparity noise (H, W) in pixels, and a number (H, W) in [0, 1) that says whether a dark or
        overexposed pixel is measured."""
        key = (shape[0], shape[1], fx)
        if key not in self._fixed:
            rng = frame_rng(self._key, _FIXED)
            noise = self._noise(rng, shape, fx, self._p.fixed_noise_px)
            self._fixed = {key: (noise, rng.random(shape, dtype=np.float32))}
        return self._fixed[key]

    def _noise(
        self, rng: np.random.Generator, shape: tuple[int, ...], fx: float, sigma_px: float
    ) -> NDArray[np.float32]:
        """Smooth noise (H, W) of standard deviation ``sigma_px``."""
        noise = rng.standard_normal(shape, dtype=np.float32)
        width_px = self._p.smoothing_px * fx / FOCAL_PX  # in pixels of the image
        if width_px > 0.0:
            kernel = cv2.getGaussianKernel(2 * int(np.ceil(3.0 * width_px)) + 1, width_px, cv2.CV_32F)
            smooth = cv2.sepFilter2D(noise, -1, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
            noise = np.asarray(smooth, dtype=np.float32)
            sigma_px /= float((kernel * kernel).sum())
        noise *= np.float32(sigma_px)
        return noise

    def _unmatched(self, image: Image, luck: NDArray[np.float32]) -> NDArray[np.bool_]:
        """Pixels (H, W) too dark or too bright to be matched."""
        p = self._p
        if not (p.dark_holes or p.bright_holes):
            return np.zeros(luck.shape, dtype=bool)
        gray = cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY)
        return ((gray < p.dark_below) & (luck < p.dark_holes)) | ((gray > p.bright_above) & (luck < p.bright_holes))

    def _silhouettes(
        self, inverse: NDArray[np.float32], hole: NDArray[np.bool_], rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Mark silhouettes' pixels in ``hole`` (H, W), and return inverse depth (H, W) in which others fly."""
        at = np.nonzero(_silhouette(inverse))
        draws = rng.random((3, at[0].size), dtype=np.float32)
        hole[at] |= draws[0] < self._p.silhouette_holes
        flies = draws[1] < self._p.flying
        near, far = cv2.dilate(inverse, _NEIGHBORS)[at], cv2.erode(inverse, _NEIGHBORS)[at]
        out = inverse.copy()
        out[at] = np.where(flies, far + draws[2] * (near - far), inverse[at])
        return out


def _silhouette(inverse: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Pixels (H, W) beside a jump of inverse depth (H, W), on both of its sides. Inverse depth of a plane is linear in
    the image, so slanted planes have none."""
    one = np.ones(1, dtype=np.float32)
    across = cv2.sepFilter2D(inverse, -1, _SECOND_DIFFERENCE, one, borderType=cv2.BORDER_REPLICATE)
    down = cv2.sepFilter2D(inverse, -1, one, _SECOND_DIFFERENCE, borderType=cv2.BORDER_REPLICATE)
    return np.maximum(np.abs(across), np.abs(down)) > _JUMP_PX / (FOCAL_PX * BASELINE_M)


def _second_imager_misses(inverse: NDArray[np.float32], scale: float) -> NDArray[np.bool_]:
    """Pixels (H, W) that a second imager to the right of the camera does not see, because something nearer is in front.

    scale: disparity, in pixels of the image, of an inverse depth of 1 / m. A point in column x lies in column
    x - disparity of the second image. It is hidden if a pixel to its right lies as far left or farther there. The
    image's border, where the second image ends, counts as seen: the sensor sees more than the image.
    """
    column = np.arange(inverse.shape[1], dtype=np.float32) - np.float32(scale) * inverse
    leftmost = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    hidden = np.zeros(inverse.shape, dtype=bool)
    hidden[:, :-1] = column[:, :-1] >= leftmost[:, 1:]
    return hidden
