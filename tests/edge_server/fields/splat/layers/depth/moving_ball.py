"""A ball that goes around on a plate before few cameras, and a small field of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import psnr, seen

SMALL = SplatSettings(gaussians=1200, start=700, seed_cells=32, densify_every=20, threads=2)
FRAME_S = 1.0 / 15.0


def place_m(instant_s: float) -> NDArray[np.float64]:
    return np.array([0.25 * np.cos(3 * instant_s), 0.25 * np.sin(3 * instant_s), 0.5])


def measured(view: View, image: NDArray, distance_m: NDArray[np.float64]) -> View:
    """The view with this image and depth along the optical axis, 0 for the sky."""
    z = np.where(np.isfinite(distance_m), distance_m * view.intrinsics.rays()[..., 2], 0.0)
    return replace(view, image=image.astype(np.uint8), depth=z.astype(np.float32))


def taken(view: View, instant_s: float) -> View:
    """What a camera sees and measures then."""
    now = measured(view, *seen(view.intrinsics, view.camera_to_world, place_m(instant_s)))
    return replace(now, generated_ns=round(instant_s * 1e9))


def score(field: LayeredField, held: View, instant_s: float) -> float:
    """PSNR of what is shown to a held-out camera, dB; fails where it is not finite."""
    color = field.snapshot().render(held.camera_to_world, held.intrinsics).color
    assert np.isfinite(color).all()
    return psnr(color, taken(held, instant_s).image / 255.0)
