"""An immutable copy of a field with rays: renders from any thread while the field itself trains on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.rays import Space
from edge_server.fields.common.kernels.render import ROW, render_tiles
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool
from freshfield.geometry import Pinhole

Pixels = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Color (N, 3), depth (N,) in meters and opacity (N,) at N image points."""


@dataclass(frozen=True)
class RaySnapshot:
    """Parameters and occupancy of one instant. Nothing in it is written after it is made.

    settings: of the field. levels: how many levels of the encoding are in use. background: float32 (3,).
    step: of the field.
    """

    settings: Any
    box: SceneBox
    encoding: Any
    levels: int
    net: Net
    space: Space
    background: NDArray[np.float32]
    pool: Pool
    step: int

    def at(self, present_ns: int) -> Self:
        """Itself: it knows no motion."""
        return self

    def copied(self) -> Self:
        """See ``stepped_field.StepSnapshot``."""
        space = self.space._replace(
            occupied=self.space.occupied.copy(), coarse=self.space.coarse.copy(), density=np.zeros(0, np.float32)
        )
        encoding = self.encoding._replace(table=self.encoding.table.copy())
        return replace(self, encoding=encoding, net=Net(self.net.widths, self.net.params.copy()), space=space)

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """Render a camera."""
        w, h = intrinsics.width, intrinsics.height
        v, u = np.mgrid[0:h, 0:w]
        pixels = np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=-1)
        color, depth, opacity = self.render_pixels(camera_to_world, intrinsics, pixels)
        return Rendering(color.reshape(h, w, 3), depth.reshape(h, w), opacity.reshape(h, w))

    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> Pixels:
        """What a camera sees at image points (N, 2)."""
        pose = np.asarray(camera_to_world, dtype=np.float64)
        lens, rotation = np.array(lens_row(intrinsics), dtype=np.float64), np.ascontiguousarray(pose[:3, :3])
        camera, n = (lens, rotation, self.box.normalise(pose[:3, 3])), len(pixels)
        out = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        units, pixels = int(self.net.widths.sum()), np.ascontiguousarray(pixels, dtype=np.float64)
        scratch = tuple(np.empty((self.pool.threads, rows, ROW), np.float32) for rows in (units, 3, 3))
        model, degree = (self.encoding, self.levels, self.net), self.settings.sh_degree
        self.pool.run(render_tiles, camera, pixels, self.space, model, degree, self.background, scratch, out)
        color, depth, opacity = out
        depth *= np.float32(self.box.radius_m)
        return color, depth, opacity
