"""An immutable copy of a trained field: renders from any thread while the field itself trains on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
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


class PixelSnapshot(ABC):
    """An immutable copy of a field that knows no motion, rendered pixel by pixel."""

    cameras: tuple[View, ...]

    @abstractmethod
    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> Pixels:
        """What a camera sees at image points (N, 2)."""

    def at(self, present_ns: int) -> Self:
        """Itself."""
        return self

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


def run_by_pixel(
    pool: Pool,
    kernel: Callable[..., None],
    box: SceneBox,
    camera_to_world: NDArray[np.float64],
    intrinsics: Pinhole,
    pixels: NDArray[np.float64],
    *args: Any,
) -> Pixels:
    """Run a kernel that renders image points.

    kernel: takes a lens row, rotation, origin (scene units) and image points, then ``args``, then arrays for
        color, depth (scene units) and opacity to write into.
    """
    pose = np.asarray(camera_to_world, dtype=np.float64)
    n = len(pixels)
    color, depth, opacity = np.empty((n, 3), np.float32), np.empty(n, np.float32), np.empty(n, np.float32)
    pool.run(
        kernel,
        np.array(lens_row(intrinsics), dtype=np.float64),
        np.ascontiguousarray(pose[:3, :3]),
        box.normalise(pose[:3, 3]),
        np.ascontiguousarray(pixels, dtype=np.float64),
        *args,
        color,
        depth,
        opacity,
    )
    depth *= np.float32(box.radius_m)
    return color, depth, opacity


@dataclass(frozen=True)
class RaySnapshot(PixelSnapshot):
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

    def copied(self) -> Self:
        """See ``stepped_field.StepSnapshot``."""
        space = self.space._replace(
            occupied=self.space.occupied.copy(), coarse=self.space.coarse.copy(), density=np.zeros(0, np.float32)
        )
        encoding = self.encoding._replace(table=self.encoding.table.copy())
        return replace(self, encoding=encoding, net=Net(self.net.widths, self.net.params.copy()), space=space)

    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> Pixels:
        """See ``PixelSnapshot``."""
        room, workers = TILE * ROUND, self.pool.threads
        return run_by_pixel(
            self.pool,
            render_tiles,
            self.box,
            camera_to_world,
            intrinsics,
            pixels,
            self.space,
            self.encoding,
            self.levels,
            self.net,
            self.harmonics,
            self.background,
            np.empty((workers, int(self.net.widths.sum()), room), np.float32),
            np.empty((workers, 3, room), np.float32),
            np.empty((workers, 2, room), np.float32),
        )
