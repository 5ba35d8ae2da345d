"""An immutable copy of a Gaussian field, which renders from any thread while the field trains on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Rendering
from edge_server.fields.common.camera_rows import camera_rows, ray_lengths
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.rasterize import render_tiles
from freshfield.geometry import Pinhole


@dataclass(frozen=True)
class SplatSnapshot:
    """Gaussians, never written after construction.

    params: float32 (N, P), see ``kernels.project``.
    planar: the Gaussians are flat, so ``render_surface`` renders depth from their planes.
    """

    box: SceneBox
    params: NDArray[np.float32]
    background: NDArray[np.float32]
    pool: Pool
    step: int
    planar: bool = False

    def at(self, present_ns: int | None) -> Self:
        """The same: nothing moves."""
        return self

    def copied(self) -> Self:
        """See ``stepped_field.StepSnapshot``."""
        return replace(self, params=self.params.copy())

    def render_surface(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """As ``render``, with the depth at which rays meet the Gaussians' planes (see ``planar``)."""
        from edge_server.fields.splat.planar import plane_depth  # compiled only where it is used

        image = self.render(camera_to_world, intrinsics)
        raster, cams = self._project(camera_to_world, intrinsics)
        depth, opacity = plane_depth(raster, self.params, cams[0], intrinsics)
        return Rendering(image.color, depth * np.float32(self.box.radius_m), opacity)

    def render(self, camera_to_world: NDArray[np.float64], intrinsics: Pinhole) -> Rendering:
        """Render a camera. camera_to_world: (4, 4), meters. Depth is in meters along each ray."""
        w, h = intrinsics.width, intrinsics.height
        raster, _ = self._project(camera_to_world, intrinsics)
        color, depth = np.empty((h, w, 3), np.float32), np.empty((h, w), np.float32)
        opacity = np.empty((h, w), np.float32)
        self.pool.run(render_tiles, raster.raster, self.background, color, depth, opacity)
        depth *= ray_lengths(intrinsics) * np.float32(self.box.radius_m)
        return Rendering(color, depth, opacity)

    def _project(self, pose: NDArray[np.float64], lens: Pinhole) -> tuple[RasterBuffers, NDArray[np.float32]]:
        """Fresh buffers with the Gaussians that one camera sees, and that camera's row."""
        raster, cams = RasterBuffers(self.pool), camera_rows([pose], [lens], self.box)
        raster.project_and_bin(cams, self.params, differentiate=False)
        return raster, cams
