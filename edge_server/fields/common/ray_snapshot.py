"""An immutable copy of a trained field: renders from any thread while the field itself trains on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering, View
from edge_server.fields.common.kernels.mlp import Net
from edge_server.fields.common.kernels.rays import Space
from edge_server.fields.common.kernels.render import ROUND, TILE, render_tiles
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.common.view_store import PixelRenderer
from freshfield.geometry import Pinhole

SOLID = 0.5  # opacity from which on a ray has met a surface


@dataclass(frozen=True)
class RaySnapshot:
    """Parameters, occupancy and cameras of one instant. Nothing in it is written after it is made."""

    box: SceneBox
    encoding: Any
    levels: int
    net: Net
    harmonics: int
    space: Space
    background: NDArray[np.float32]
    cameras: tuple[View, ...]
    pool: Pool
    step: int

    def at(self, present_ns: int) -> RaySnapshot:
        """Itself: nothing in it is known to move."""
        return self

    def render(
        self,
        camera_to_world: NDArray[np.float64],
        intrinsics: Pinhole,
        max_samples: int | None = None,
    ) -> Rendering:
        """Render a camera. max_samples: of a ray at most (fewer are faster)."""
        w, h = intrinsics.width, intrinsics.height
        v, u = np.mgrid[0:h, 0:w]
        pixels = np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=-1)
        color, depth, opacity = self.render_pixels(camera_to_world, intrinsics, pixels, max_samples)
        return Rendering(color.reshape(h, w, 3), depth.reshape(h, w), opacity.reshape(h, w))

    def render_pixels(
        self,
        camera_to_world: NDArray[np.float64],
        intrinsics: Pinhole,
        pixels: NDArray[np.float64],
        max_samples: int | None = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Color (N, 3), depth (N,) in metres and opacity (N,) at image points (N, 2)."""
        pose = np.asarray(camera_to_world, dtype=np.float64)
        n, room, workers = len(pixels), TILE * ROUND, self.pool.threads
        color, depth = np.empty((n, 3), np.float32), np.empty(n, np.float32)
        opacity = np.empty(n, np.float32)
        self.pool.run(
            render_tiles,
            np.array(lens_row(intrinsics), dtype=np.float64),
            np.ascontiguousarray(pose[:3, :3]),
            self.box.normalise(pose[:3, 3]),
            np.ascontiguousarray(pixels, dtype=np.float64),
            self.space,
            self.encoding,
            self.levels,
            self.net,
            self.harmonics,
            max_samples or 1 << 30,
            self.background,
            np.empty((workers, int(self.net.widths.sum()), room), np.float32),
            np.empty((workers, 3, room), np.float32),
            np.empty((workers, 2, room), np.float32),
            color,
            depth,
            opacity,
        )
        depth *= np.float32(self.box.radius_m)
        return color, depth, opacity

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """See ``surface_points``; from all known cameras."""
        return surface_points(self, self.cameras, count)


def surface_points(
    renderer: PixelRenderer, cameras: Sequence[View], count: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """At most ``count`` points (N, 3) in world metres and colors (N, 3): where the rays of evenly spaced
    pixels of ``cameras`` meet a surface."""
    positions, colors = [np.zeros((0, 3), np.float32)], [np.zeros((0, 3), np.float32)]
    share = max(count // max(len(cameras), 1), 1)
    for view in cameras:
        camera = view.intrinsics
        stride = max(np.sqrt(camera.width * camera.height / share), 1.0)
        u, v = np.meshgrid(
            np.arange(0.5 * stride, camera.width, stride), np.arange(0.5 * stride, camera.height, stride)
        )
        pixels = np.floor(np.stack([u.ravel(), v.ravel()], axis=-1)) + 0.5
        color, depth, opacity = renderer.render_pixels(view.camera_to_world, camera, pixels)
        solid = (opacity > SOLID) & (depth > 0)
        rays = camera.rays(pixels[solid]) @ view.camera_to_world[:3, :3].T
        points = view.camera_to_world[:3, 3] + rays * depth[solid, None]
        positions.append(points.astype(np.float32))
        colors.append(color[solid])
    return np.concatenate(positions)[:count], np.concatenate(colors)[:count]
