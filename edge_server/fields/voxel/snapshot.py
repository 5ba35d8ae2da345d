"""An immutable copy of a voxel field, which renders from any thread while the field trains on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering, View
from edge_server.fields.common.ray_snapshot import surface_points
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.voxel.kernels.rays import MAX_SAMPLES, RayScratch, SkipGrid, Voxels, render_rays
from freshfield.geometry import Pinhole


def make_ray_scratch(workers: int) -> RayScratch:
    """Scratch memory for that many workers."""
    return RayScratch(
        row=np.zeros((workers, MAX_SAMPLES), np.int64),
        line=np.zeros((workers, MAX_SAMPLES, 9), np.float32),
        ray=np.zeros((workers, 12), np.float32),
    )


@dataclass(frozen=True)
class VoxelSnapshot:
    """Grid, occupancy and cameras of one instant, never written after construction."""

    box: SceneBox
    voxels: Voxels
    space: SkipGrid
    background: NDArray[np.float32]
    cameras: tuple[View, ...]
    pool: Pool
    step: int

    def at(self, present_ns: int) -> VoxelSnapshot:
        """Itself: nothing in it is known to move."""
        return self

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """The picture a camera at this pose would take."""
        w, h = intrinsics.width, intrinsics.height
        v, u = np.mgrid[0:h, 0:w]
        pixels = np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=-1)
        color, depth, opacity = self.render_pixels(camera_to_world, intrinsics, pixels)
        return Rendering(color.reshape(h, w, 3), depth.reshape(h, w), opacity.reshape(h, w))

    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Color (N, 3), depth (N,) in meters and opacity (N,) at image points (N, 2)."""
        pose = np.asarray(camera_to_world, dtype=np.float64)
        n = len(pixels)
        color, depth = np.empty((n, 3), np.float32), np.empty(n, np.float32)
        opacity = np.empty(n, np.float32)
        self.pool.run(
            render_rays,
            np.array(lens_row(intrinsics), dtype=np.float64),
            np.ascontiguousarray(pose[:3, :3]),
            self.box.normalise(pose[:3, 3]),
            np.ascontiguousarray(pixels, dtype=np.float64),
            self.space,
            self.voxels,
            self.background,
            make_ray_scratch(self.pool.threads),
            color,
            depth,
            opacity,
        )
        depth *= np.float32(self.box.radius_m)
        return color, depth, opacity

    def points(self, count: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Up to ``count`` points (N, 3) in world meters, with colors (N, 3), where the known cameras' rays
        meet a surface."""
        return surface_points(self, self.cameras, count)
