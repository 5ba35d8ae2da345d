"""An immutable copy of a field with rays: renders from any thread while the field itself trains on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering, View
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.rays import Space
from edge_server.fields.common.kernels.render import ROUND, TILE, render_tiles
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool
from freshfield.geometry import Pinhole

SOLID = 0.5  # opacity from which on a ray has met a surface

Pixels = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
"""Color (N, 3), depth (N,) in meters and opacity (N,) at N image points."""


@dataclass(frozen=True)
class RaySnapshot:
    """Parameters, occupancy and cameras of one instant. Nothing in it is written after it is made.

    settings: of the field. levels: how many levels of the encoding are in use. background: float32 (3,).
    cameras: the newest view of each camera. step: of the field.
    """

    settings: Any
    box: SceneBox
    encoding: Any
    levels: int
    net: Net
    space: Space
    background: NDArray[np.float32]
    cameras: tuple[View, ...]
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

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """At most ``count`` points (N, 3) in world meters and colors (N, 3): where the rays of evenly spaced
        pixels of ``cameras`` meet a surface."""
        positions, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
        share = max(count // max(len(self.cameras), 1), 1)
        for view in self.cameras:
            camera = view.intrinsics
            stride = max(np.sqrt(camera.width * camera.height / share), 1.0)
            u, v = np.meshgrid(
                np.arange(0.5 * stride, camera.width, stride), np.arange(0.5 * stride, camera.height, stride)
            )
            pixels = np.floor(np.stack([u.ravel(), v.ravel()], axis=-1)) + 0.5
            color, depth, opacity = self.render_pixels(view.camera_to_world, camera, pixels)
            solid = (opacity > SOLID) & (depth > 0)
            rays = camera.rays(pixels[solid]) @ view.camera_to_world[:3, :3].T
            points = view.camera_to_world[:3, 3] + rays * depth[solid, None]
            positions.append(points.astype(np.float32))
            colors.append(color[solid])
        return np.concatenate(positions)[:count], np.concatenate(colors)[:count]

    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> Pixels:
        """What a camera sees at image points (N, 2)."""
        pose = np.asarray(camera_to_world, dtype=np.float64)
        lens, rotation = np.array(lens_row(intrinsics), dtype=np.float64), np.ascontiguousarray(pose[:3, :3])
        camera = lens, rotation, self.box.normalise(pose[:3, 3]), np.ascontiguousarray(pixels, dtype=np.float64)
        n = len(pixels)
        out = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
        self._run(camera, out)
        color, depth, opacity = out
        depth *= np.float32(self.box.radius_m)
        return color, depth, opacity

    def _run(self, camera: tuple[NDArray[np.float64], ...], out: Pixels) -> None:
        """Run the kernel that renders ``camera`` (lens row, rotation, origin in scene units, image points) into
        ``out``, with depth in scene units."""
        model = self.space, self.encoding, self.levels, self.net, self.settings.harmonics, self.background
        self.pool.run(render_tiles, *camera, *model, *self._scratch(TILE * ROUND, 2), *out)

    def _scratch(self, samples: int, rows: int) -> Pixels:
        """Memory of a rendering kernel's workers: activations, points and ``rows`` numbers of ``samples`` samples."""
        shapes = (int(self.net.widths.sum()), samples), (3, samples), (rows, samples)
        acts, x, line = (np.empty((self.pool.threads, *shape), np.float32) for shape in shapes)
        return acts, x, line
