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
from edge_server.fields.splat.kernels.project import QUATERNION, SCALE, Gaussians
from edge_server.fields.splat.kernels.rasterize_planes import accumulate_normals, render_planes
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


def plane_depth(
    raster: RasterBuffers, gaussians: Gaussians, camera: NDArray[np.float32], lens: Pinhole
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth (H, W) along the rays, scene units, and opacity (H, W). Depth is 0 where the plane is seen at too
    flat an angle.

    raster: buffers whose last ``project_and_bin`` had this camera first.
    camera: float32 (CAMERA,), its row.
    """
    width, height = int(camera[SIZE]), int(camera[SIZE + 1])
    out = np.zeros((height, width, 5), np.float32)
    raster.pool.run(render_planes, raster.first, gaussian_planes(gaussians, camera), out)
    rays = lens.rays()
    along = (out[..., :3] * rays).sum(axis=-1)
    opacity = np.clip(np.nan_to_num(out[..., 4]), 0.0, 1.0)
    good = np.isfinite(out).all(axis=-1) & (along < -STEEPEST * opacity) & (opacity > 1e-3)
    depth = np.where(good, out[..., 3] / np.where(good, along, 1.0), 0.0)
    return np.where(depth > 0, depth, 0.0).astype(np.float32), opacity.astype(np.float32)


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
    together. camera: its row; ``raster`` has the whole image of it at slot 0."""
    gaussians = cloud.gaussians()
    depth, opacity = plane_depth(raster, gaussians, camera, lens)
    normal_sums = np.zeros((raster.lists.pair.shape[1], 4), np.float32)
    raster.pool.run(accumulate_normals, raster.first, depth_normals(depth, opacity, lens), normal_sums)
    first, count = raster.lists.own_first[0, : len(cloud)], raster.lists.own_count[0, : len(cloud)]
    which = np.flatnonzero(count > 0)
    sums = np.concatenate([np.zeros((1, 4)), np.cumsum(normal_sums.astype(np.float64), axis=0)])
    seen_normals = sums[first[which] + count[which]] - sums[first[which]]
    valid = seen_normals[:, 3] > 1e-3
    which, seen_normals = which[valid], seen_normals[valid]
    if not len(which):
        return
    wanted = seen_normals[:, :3] / seen_normals[:, 3:] @ camera[:ORIGIN].reshape(3, 3).astype(np.float64)
    normal = gaussian_normals(cloud.params[which])
    # A normal and its opposite are one plane.
    wanted *= np.where((wanted * normal).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    half_turn = 0.5 * share * np.cross(normal, wanted)
    step = np.concatenate([np.ones((len(half_turn), 1)), half_turn], axis=1)
    part = slice(QUATERNION, QUATERNION + 4)
    cloud.params[which, part] = quaternion_normalize(quaternion_multiply(step, unit_quaternions(cloud.params[which])))


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
