"""An immutable copy of a voxel field, which renders from any thread while the field trains on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.ray_snapshot import Pixels, PixelSnapshot, run_by_pixel
from edge_server.fields.common.scene_box import SceneBox
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
class VoxelSnapshot(PixelSnapshot):
    """Grid, occupancy and cameras of one instant, never written after construction."""

    box: SceneBox
    voxels: Voxels
    space: SkipGrid
    background: NDArray[np.float32]
    cameras: tuple[View, ...]
    pool: Pool
    step: int

    def copied(self) -> VoxelSnapshot:
        """See ``stepped_field.StepSnapshot``."""
        voxels = self.voxels._replace(table=self.voxels.table.copy())
        return replace(self, voxels=voxels, space=self.space._replace(clearance=self.space.clearance.copy()))

    def render_pixels(
        self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole, pixels: NDArray[np.float64]
    ) -> Pixels:
        """See ``PixelSnapshot``."""
        return run_by_pixel(
            self.pool,
            render_rays,
            self.box,
            camera_to_world,
            intrinsics,
            pixels,
            self.space,
            self.voxels,
            self.background,
            make_ray_scratch(self.pool.threads),
        )
