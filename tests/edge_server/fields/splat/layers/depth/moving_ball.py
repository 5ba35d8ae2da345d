"""A ball that goes around on a plate before few cameras, and a small field of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, View
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import psnr, ring, seen

SMALL = SplatSettings(gaussians=1200, start=700, seed_cells=32, densify_every=20, threads=2)
FRAME_S = 1.0 / 15.0


def place_m(instant_s: float) -> NDArray[np.float64]:
    return np.array([0.25 * np.cos(3 * instant_s), 0.25 * np.sin(3 * instant_s), 0.5])


def measured(view: View, image: NDArray, distance_m: NDArray[np.float64]) -> View:
    """The view with this image and depth along the optical axis, 0 for the sky."""
    z = np.where(np.isfinite(distance_m), distance_m * view.intrinsics.rays()[..., 2], 0.0)
    return replace(view, image=image.astype(np.uint8), depth=z.astype(np.float32))


class Rig:
    """Some cameras of a ring of nine, with depth or without, and one that is held out."""

    def __init__(self, cameras: tuple[int, ...], held: int, size: int = 48, depth: bool = True) -> None:
        views = ring(9, size)
        self.cameras, self.held, self.depth = [views[k] for k in cameras], views[held], depth
        self._taken: dict[tuple[int, int], View] = {}

    def frame(self, camera: int, frame: int) -> View:
        """What a camera sees and measures then, each at a phase of its own."""
        if (camera, frame) not in self._taken:
            view, instant_s = self.cameras[camera], (frame + camera / len(self.cameras)) * FRAME_S
            now = measured(view, *seen(view.intrinsics, view.camera_to_world, place_m(instant_s)))
            now = replace(now, generated_ns=round(instant_s * 1e9))
            self._taken[camera, frame] = now if self.depth else replace(now, depth=None)
        return self._taken[camera, frame]

    def run(
        self,
        field: LayeredField,
        frames: range,
        changed: Callable[[int, int, View], View] = lambda camera, frame, view: view,
        cameras: int = 3,
        steps: int = 20,
    ) -> LayeredField:
        """The field after these frames, each as ``changed``."""
        for frame in frames:
            views = [changed(k, frame, self.frame(k, frame)) for k in range(cameras)]
            field.fit(views, Budget(steps=steps))
        return field

    def score(self, field: LayeredField, frame: int) -> float:
        """PSNR of what is shown to the held-out camera, dB; fails where it is not finite."""
        lens, pose = self.held.intrinsics, self.held.camera_to_world
        color = field.snapshot().render(pose, lens).color
        assert np.isfinite(color).all()
        return psnr(color, seen(lens, pose, place_m(frame * FRAME_S))[0] / 255.0)
