"""The depth plate of a fixed camera: how far what stands still is, beside the plate that says what it looks like.

The median of a pixel's last depths, where it was not foreground, is smoothed along surfaces: each pixel takes the plane
that fits the inverse depths around it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.field_state import give_attributes, take_attributes
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.kernels.depth_plate import (
    fill_holes,
    find_medians,
    fit_planes,
    remember_depths,
)

Arrays = dict[str, NDArray[Any]]
_KEPT = ("samples", "count", "refused")  # of a state


@dataclass
class DepthPlate:
    """The last depths of each pixel of one camera.

    samples: float32 (H, W, KEPT), a ring of inverse depths, 1 / m. count: int32 (H, W), depths taken in.
    refused: images in a row that contradicted it.
    """

    samples: NDArray[np.float32]
    count: NDArray[np.int32]
    refused: int = 0

    @classmethod
    def empty(cls, height: int, width: int) -> DepthPlate:
        """A plate of a camera that has measured nothing yet."""
        return cls(np.zeros((height, width, tuned.KEPT), np.float32), np.zeros((height, width), np.int32))

    def take(self, depth: NDArray[np.float32], foreground: NDArray[np.bool_]) -> bool:
        """Take in the depth of a frame, see ``kernels.depth_plate.remember_depths``.

        Returns False, and takes nothing in, if it contradicts what was measured before. After MOST_REFUSED such images
        in a row the plate begins anew.
        """
        depth = np.array(depth, np.float32)  # another layout, or one that may not be written, would be compiled anew
        if self._contradicts(depth, foreground):
            self.refused += 1
            if self.refused <= tuned.MOST_REFUSED:
                return False
            self.count[:] = 0
        self.refused = 0
        remember_depths(depth, foreground, self.samples, self.count)
        return True

    def _contradicts(self, depth: NDArray[np.float32], foreground: NDArray[np.bool_]) -> bool:
        """Whether most of what stands still, looked at in some pixels, is far from where it was measured last: depth of
        another unit, or of another camera."""
        some = np.s_[:: tuned.LOOKED_AT, :: tuned.LOOKED_AT]
        now, count = depth[some], self.count[some]
        last = np.take_along_axis(self.samples[some], ((count - 1) % tuned.KEPT)[..., None], axis=2)[..., 0]
        with np.errstate(invalid="ignore", over="ignore"):
            both = (count >= tuned.LEAST) & ~foreground[some] & (now > 0.0) & np.isfinite(now)
            ratio = (now * last)[both]
        alike = np.count_nonzero((ratio > tuned.ALIKE) & (ratio < 1.0 / tuned.ALIKE))
        return bool(ratio.size >= tuned.LEAST_LOOKED_AT and 2 * alike < ratio.size)

    def is_known(self, plate: NDArray[np.bool_]) -> bool:
        """Whether most of the pixels that measure anything have enough depths for a median. Others may be beyond the
        sensor's range for good. plate: bool (H, W), where the color is known."""
        measured, known = np.count_nonzero(plate & (self.count > 0)), np.count_nonzero(plate & self._has_enough)
        return bool(measured > 0 and 2 * known >= measured)

    def is_steady(self, inverse: NDArray[np.float32]) -> bool:
        """Whether most of the pixels with enough depths have a median: of noise they have none. inverse: see
        ``medians``."""
        return bool(2 * np.count_nonzero(inverse) > np.count_nonzero(self._has_enough))

    @property
    def _has_enough(self) -> NDArray[np.bool_]:
        return self.count >= tuned.LEAST

    def copied(self) -> DepthPlate:
        """The same with arrays of its own, for another thread."""
        return DepthPlate(self.samples.copy(), self.count.copy(), self.refused)

    def medians(self, pool: Pool) -> NDArray[np.float32]:
        """Inverse depth of each pixel, float32 (H, W), 1 / m; 0 unknown."""
        inverse = np.empty(self.count.shape, np.float32)
        pool.run(find_medians, self.samples, self.count, inverse)
        return inverse

    def state(self) -> Arrays:
        """Everything needed to continue bit for bit."""
        return take_attributes(self, _KEPT)

    def load_state(self, state: Arrays) -> None:
        """Continue from ``state``. KeyError, ValueError: it is not one of images of this size."""
        shapes = self.samples.shape, self.count.shape
        give_attributes(self, _KEPT, state)
        if (self.samples.shape, self.count.shape) != shapes:
            raise ValueError("the depths in the state are not those of images of this size")


@cache
def _window() -> NDArray[np.float32]:
    offset = np.arange(-tuned.RADIUS, tuned.RADIUS + 1)
    square = offset[:, None] ** 2 + offset**2
    return np.exp(-square / (2.0 * tuned.SPREAD_PX**2)).astype(np.float32)


def smooth(
    inverse: NDArray[np.float32], image: NDArray[np.float32], pool: Pool, noise: float = tuned.NOISE
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Smooth inverse depths along surfaces, and fill holes of a few pixels.

    inverse: float32 (H, W), 1 / m, 0 unknown. image: float32 (H, W, 3), steps of 255.
    noise: NOISE of the constants of depth.
    Returns inverse depth, float32 (H, W), and its slope a pixel to the right and down, float32 (H, W, 2).
    """
    image = np.ascontiguousarray(image, np.float32)
    (plane, filled), slope = np.empty((2, *inverse.shape), np.float32), np.empty((*inverse.shape, 2), np.float32)
    filled_slope = np.empty_like(slope)
    pool.run(fit_planes, inverse, image, _window(), noise, plane, slope)
    pool.run(fill_holes, plane, slope, image, filled, filled_slope)
    return filled, filled_slope
