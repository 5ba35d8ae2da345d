"""Gaussians that lie flat on surfaces (PGSR, Chen et al. 2024), for depth and meshes; off by default.

``flatten`` shrinks the smallest axis of every Gaussian. ``align`` turns these axes to the normals of the
rendered depth: single-view normal consistency in the form of 2DGS (Huang et al. 2024), the sum of
w_i (1 - n_i N) with fixed weights w_i. ``plane_depth`` renders depth where rays meet the blended plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import ORIGIN, SIZE
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.kernels.project import DEPTH, QUATERNION, RED, SCALE, Gaussians
from edge_server.fields.splat.kernels.rasterize import render_tiles
from edge_server.fields.splat.kernels.sum_over_pixels import sum_over_pixels
from edge_server.fields.splat.settings import ASPECT
from freshfield.geometry import Pinhole, quaternion_multiply, quaternion_normalize, quaternion_to_matrix

STEEPEST = 0.1  # cosine between ray and normal below which a plane has no depth
SURE_OPACITY = 0.7  # opacity above which the depth of a pixel gives a normal
JUMP = 0.05  # share of the depth: neighbors that differ by more lie at an edge


def gaussian_planes(gaussians: Gaussians, camera: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32 (N, 4): unit normal of each Gaussian in camera axes, facing the camera, and the plane's
    distance along it (negative), scene units. camera: a row of ``camera_rows``."""
    p = gaussians.params
    rotation = camera[:ORIGIN].reshape(3, 3).astype(np.float64)
    normal = gaussian_normals(p) @ rotation.T
    middle = (p[:, :3].astype(np.float64) - camera[ORIGIN : ORIGIN + 3]) @ rotation.T
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
    raster: RasterBuffers, gaussians: Gaussians, camera: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The Gaussians' planes, blended as their colors are: normal (H, W, 3), distance (H, W) and opacity (H, W).

    raster: buffers whose last ``project_and_bin`` had this camera first. camera: float32 (CAMERA,), its row.
    """
    shape = int(camera[SIZE + 1]), int(camera[SIZE])
    planes = raster.projected[:1].copy()
    mine, shown = gaussian_planes(gaussians, camera), planes[0, : len(gaussians.params)]
    shown[:, RED:DEPTH], shown[:, DEPTH] = 0.5 + 0.5 * mine[:, :3], mine[:, 3]  # colors lie in [0, 1]
    color, depth, opacity = (np.zeros((*shape, *more), np.float32) for more in ((3,), (), ()))
    raster.pool.run(
        render_tiles, raster.first._replace(projected=planes), np.zeros(3, np.float32), color, depth, opacity
    )
    two, least = np.float32(2.0), np.float32(1e-3)
    return two * color - opacity[..., None], depth * np.maximum(opacity, least), opacity


def plane_depth(
    raster: RasterBuffers, gaussians: Gaussians, camera: NDArray[np.float32], lens: Pinhole
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth (H, W) along the rays, scene units, and opacity (H, W). Depth is 0 where the plane is seen at too
    flat an angle. raster, camera: see ``blend_planes``."""
    normal, distance, opacity = blend_planes(raster, gaussians, camera)
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


def align(
    cloud: GaussianCloud, share: float, raster: RasterBuffers, camera: NDArray[np.float32], lens: Pinhole
) -> None:
    """Turn the Gaussians that a camera sees by ``share`` of the way to the normals of the depth that they render
    together. camera: its row; ``raster`` has the whole image of it at slot 0, ready for gradients."""
    gaussians = cloud.gaussians()
    depth, opacity = plane_depth(raster, gaussians, camera, lens)
    normals = depth_normals(depth, opacity, lens)
    reliable = normals[..., 3:]
    weight = seen_sums(raster, len(cloud), np.repeat(reliable, 3, axis=2))
    which = np.flatnonzero(weight[:, 0] > 1e-3)
    if not len(which):
        return
    seen_normals = seen_sums(raster, len(cloud), normals[..., :3] * reliable)[which] / weight[which]
    wanted = seen_normals @ camera[:ORIGIN].reshape(3, 3).astype(np.float64)
    normal = gaussian_normals(cloud.params[which])
    # A normal and its opposite are one plane.
    wanted *= np.where((wanted * normal).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    half_turn = 0.5 * share * np.cross(normal, wanted)
    step = np.concatenate([np.ones((len(half_turn), 1)), half_turn], axis=1)
    part = slice(QUATERNION, QUATERNION + 4)
    cloud.params[which, part] = quaternion_normalize(quaternion_multiply(step, unit_quaternions(cloud.params[which])))


def seen_sums(raster: RasterBuffers, count: int, values: NDArray[np.float32]) -> NDArray[np.float64]:
    """Sums (N, 3) of the pixels' values (H, W, 3), weighed by how much of a pixel is the Gaussian's, for the first
    ``count`` Gaussians."""
    raster.pool.run(sum_over_pixels, raster.first, values, raster.sums)
    lists = raster.lists
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(raster.sums[0, :, -3:].astype(np.float64), axis=0)])
    first, many = lists.own_first[0, :count], lists.own_count[0, :count]
    return np.where(many[:, None] > 0, sums[first + many] - sums[first * (many > 0)], 0.0)


def depth_normals(depth: NDArray[np.float32], opacity: NDArray[np.float32], lens: Pinhole) -> NDArray[np.float32]:
    """float32 (H, W, 4): unit normals, in camera axes and facing the camera, of the surface in ``depth``
    (H, W), and 1 where they are reliable: inside the image, where it is opaque and not at an edge."""
    rays = lens.rays()
    points = rays * depth[..., None]
    out = np.zeros((*depth.shape, 4), np.float32)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(down, right)
    length = np.linalg.norm(normal, axis=-1)
    around = np.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
    middle = depth[1:-1, 1:-1]
    reliable = (opacity[1:-1, 1:-1] > SURE_OPACITY) & (middle > 0) & (around.min(axis=0) > 0) & (length > 0)
    reliable &= np.ptp(around, axis=0) < JUMP * middle
    normal = normal / np.where(length > 0, length, 1.0)[..., None]
    normal *= np.where((normal * rays[1:-1, 1:-1]).sum(axis=-1, keepdims=True) > 0, -1.0, 1.0)
    out[1:-1, 1:-1, :3] = np.where(reliable[..., None], normal, 0.0)
    out[1:-1, 1:-1, 3] = reliable
    return out
