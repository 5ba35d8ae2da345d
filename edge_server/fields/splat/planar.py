"""Gaussians that lie flat on surfaces (PGSR, Chen et al. 2024), for depth and meshes; off by default.

``flatten`` shrinks the smallest axis of every Gaussian. ``plane_depth`` renders depth where rays meet the blended
plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import ORIGIN, SIZE
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.kernels.project import DEPTH, QUATERNION, RED, SCALE
from edge_server.fields.splat.kernels.rasterize import render_tiles
from edge_server.fields.splat.splat_constants import ASPECT, STEEPEST
from freshfield.geometry import Pinhole, quaternion_normalize, quaternion_to_matrix


def gaussian_planes(params: NDArray[np.float32], camera: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32 (N, 4): unit normal of each Gaussian in camera axes, facing the camera, and the plane's
    distance along it (negative), scene units. camera: a row of ``camera_rows``."""
    rotation = camera[:ORIGIN].reshape(3, 3).astype(np.float64)
    normal = gaussian_normals(params) @ rotation.T
    middle = (params[:, :3].astype(np.float64) - camera[ORIGIN : ORIGIN + 3]) @ rotation.T
    distance = (normal * middle).sum(axis=1, keepdims=True)
    planes = np.concatenate([normal, distance], axis=1)
    planes[distance[:, 0] > 0] *= -1.0
    return planes.astype(np.float32)


def gaussian_normals(params: NDArray[np.float32]) -> NDArray[np.float64]:
    """The shortest axis (N, 3) of each Gaussian, scene axes."""
    axes = quaternion_to_matrix(unit_quaternions(params))
    least = np.argmin(params[:, SCALE : SCALE + 3], axis=1)
    return np.take_along_axis(axes, least[:, None, None], axis=2)[:, :, 0]


def unit_quaternions(params: NDArray[np.float32]) -> NDArray[np.float64]:
    """Unit quaternions (N, 4) of Gaussians; the identity where there is no direction, as in rendering."""
    given = params[:, QUATERNION : QUATERNION + 4].astype(np.float64)
    sound = np.isfinite(given).all(axis=1) & (np.abs(given).max(axis=1, initial=0.0) > 0.0)
    return quaternion_normalize(np.where(sound[:, None], given, (1.0, 0.0, 0.0, 0.0)))


def blend_planes(
    raster: RasterBuffers, params: NDArray[np.float32], camera: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The Gaussians' planes, blended like their colors: normal (H, W, 3), distance (H, W) and opacity (H, W).

    raster: buffers whose last ``project_and_bin`` had this camera. camera: float32 (CAMERA,), its row.
    """
    shape = int(camera[SIZE + 1]), int(camera[SIZE])
    planes = raster.projected.copy()
    mine, shown = gaussian_planes(params, camera), planes[: len(params)]
    shown[:, RED:DEPTH], shown[:, DEPTH] = 0.5 + 0.5 * mine[:, :3], mine[:, 3]  # colors lie in [0, 1]
    color, depth, opacity = (np.zeros((*shape, *more), np.float32) for more in ((3,), (), ()))
    raster.pool.run(
        render_tiles, raster.raster._replace(projected=planes), np.zeros(3, np.float32), color, depth, opacity
    )
    two, least = np.float32(2.0), np.float32(1e-3)
    return two * color - opacity[..., None], depth * np.maximum(opacity, least), opacity


def plane_depth(
    raster: RasterBuffers, params: NDArray[np.float32], camera: NDArray[np.float32], lens: Pinhole
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth (H, W) along the rays, scene units, and opacity (H, W). Depth is 0 where the plane is seen at too
    flat an angle. raster, camera: see ``blend_planes``."""
    normal, distance, opacity = blend_planes(raster, params, camera)
    along = (normal * lens.rays()).sum(axis=-1)
    good = (along < -STEEPEST * opacity) & (opacity > 1e-3)
    depth = np.where(good, distance / np.where(good, along, 1.0), 0.0)
    return np.where(depth > 0, depth, 0.0).astype(np.float32), opacity


def flatten(cloud: GaussianCloud, by: float) -> None:
    """Decrease the logarithm of each Gaussian's smallest scale by ``by``: a step of a loss that is linear in it."""
    scale = cloud.params[:, SCALE : SCALE + 3]
    rows, least = np.arange(len(scale)), np.argmin(scale, axis=1)
    thinnest = scale.max(axis=1) - np.float32(np.log(ASPECT))
    scale[rows, least] = np.maximum(scale[rows, least] - np.float32(by), np.minimum(thinnest, scale[rows, least]))
