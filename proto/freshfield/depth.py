"""An image of measured depth, as a camera gives it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole, Pose


@dataclass(frozen=True)
class DepthImage:
    """Depth along the optical axis, measured with (and usually at the instant of) an image.

    counts: uint16 (H, W), depth in counts; 0 where nothing was measured.
    meters_per_count: .001 where counts are millimeters.
    intrinsics: of the depth sensor, for H x W pixels. None: each pixel is registered to the image, whose
        intrinsics, scaled to H x W, hold.
    to_camera: pose of the depth sensor in the axes of the image's camera; None: they are the same.
    captured_ns: when it was measured, on the node's clock; None: at the instant of the image.
    """

    counts: NDArray[np.uint16]
    meters_per_count: float
    intrinsics: Pinhole | None = None
    to_camera: Pose | None = None
    captured_ns: int | None = None

    def meters(self) -> NDArray[np.float32]:
        """Depth in meters, float32 (H, W); 0 where nothing was measured."""
        return self.counts * np.float32(self.meters_per_count)
