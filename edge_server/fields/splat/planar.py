"""Gaussians that lie flat on surfaces (PGSR, Chen et al. 2024), for depth and meshes; off unless asked for.

Three parts: the smallest axis of every Gaussian is pulled to nothing (``flatten``), the axes turn to the
normals of the depth that the Gaussians show together (``align``: single-view normal consistency in the form
of 2DGS, Huang et al. 2024, sum of w_i (1 - n_i N), with the weights w_i held fixed), and depth is where rays
meet the blended plane (``plane_depth``).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.thread_pool import Pool
from edge_server.fields.splat.buffers import Passes
from edge_server.fields.splat.densification import Cloud
from edge_server.fields.splat.kernels.project import ORIGIN, QUATERNION, SCALE, SIZE, Gaussians
from edge_server.fields.splat.kernels.rasterize_planes import render_planes, tell_normals
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole, quaternion_multiply, quaternion_normalize, quaternion_to_matrix

STEEPEST = 0.1  # cosine between ray and normal below which a plane has no depth
SURE_OPACITY = 0.7  # of a pixel whose depth has a normal to teach
JUMP = 0.05  # of the depth, between neighbours, from which on it is an edge


def planes_of(gaussians: Gaussians, camera: NDArray[np.float32]) -> NDArray[np.float32]:
    """float32 (N, 4): unit normal of each Gaussian's flattest side in camera axes, turned to the camera, and
    the plane's distance along it (negative), scene units. camera: a row of ``camera_rows``."""
    p = gaussians.params
    turn = camera[:ORIGIN].reshape(3, 3).astype(np.float64)
    normal = normals_of(p) @ turn.T
    middle = (p[:, :3].astype(np.float64) - camera[ORIGIN : ORIGIN + 3]) @ turn.T
    distance = (normal * middle).sum(axis=1, keepdims=True)
    planes = np.concatenate([normal, distance], axis=1)
    planes[distance[:, 0] > 0] *= -1.0
    return planes.astype(np.float32)


def normals_of(params: NDArray[np.float32]) -> NDArray[np.float64]:
    """The axis (N, 3) of every Gaussian along which it is smallest, scene axes."""
    turn = quaternion_to_matrix(directed(params))
    least = np.argmin(params[:, SCALE : SCALE + 3], axis=1)
    return np.take_along_axis(turn, least[:, None, None], axis=2)[:, :, 0]


def directed(params: NDArray[np.float32]) -> NDArray[np.float64]:
    """Unit quaternions (N, 4) of Gaussians; one without a direction turns nothing, as when it is rendered."""
    given = params[:, QUATERNION : QUATERNION + 4].astype(np.float64)
    sound = np.isfinite(given).all(axis=1) & (np.abs(given).max(axis=1, initial=0.0) > 0.0)
    return quaternion_normalize(np.where(sound[:, None], given, (1.0, 0.0, 0.0, 0.0)))


def plane_depth(
    passes: Passes,
    pool: Pool,
    gaussians: Gaussians,
    camera: NDArray[np.float32],
    lens: Pinhole,
    slot: int = 0,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Depth (H, W) along the rays, scene units, 0 where the plane is seen too flat, and opacity (H, W), of
    a camera that ``passes`` has looked through last as ``slot``."""
    width, height = int(camera[SIZE]), int(camera[SIZE + 1])
    out = np.zeros((height, width, 5), np.float32)
    pool.run(
        render_planes, slot, int(passes.columns[slot]), int(passes.rows[slot]), width, height,
        passes.projected, passes.lists, planes_of(gaussians, camera), passes.memory, passes.kept, out,
    )  # fmt: skip
    rays = lens.rays()
    along = (out[..., :3] * rays).sum(axis=-1)
    opacity = np.clip(np.nan_to_num(out[..., 4]), 0.0, 1.0)
    good = np.isfinite(out).all(axis=-1) & (along < -STEEPEST * opacity) & (opacity > 1e-3)
    depth = np.where(good, out[..., 3] / np.where(good, along, 1.0), 0.0)
    return np.where(depth > 0, depth, 0.0).astype(np.float32), opacity.astype(np.float32)


def flatten(cloud: Cloud, settings: SplatSettings) -> None:
    """A step of the pull on each Gaussian's smallest axis: a loss that is linear in its logarithm."""
    scale = cloud.params[:, SCALE : SCALE + 3]
    rows, least = np.arange(len(scale)), np.argmin(scale, axis=1)
    thinnest = scale.max(axis=1) - np.float32(np.log(settings.aspect))
    scale[rows, least] = np.maximum(
        scale[rows, least] - np.float32(settings.flatten), np.minimum(thinnest, scale[rows, least])
    )


def align(
    cloud: Cloud,
    settings: SplatSettings,
    passes: Passes,
    pool: Pool,
    camera: NDArray[np.float32],
    lens: Pinhole,
) -> None:
    """Turn the Gaussians that ``camera`` (slot 0 of ``passes``, all of it) sees towards the normals of the
    depth that they show together."""
    gaussians = cloud.gaussians(settings.harmonics)
    depth, opacity = plane_depth(passes, pool, gaussians, camera, lens)
    height, width = depth.shape
    told = np.zeros((passes.lists.pair.shape[1], 4), np.float32)
    pool.run(
        tell_normals, 0, int(passes.columns[0]), int(passes.rows[0]), width, height, passes.projected,
        passes.lists, depth_normals(depth, opacity, lens), passes.memory, passes.kept, told,
    )  # fmt: skip
    first, count = passes.lists.own_first[0, : len(cloud)], passes.lists.own_count[0, : len(cloud)]
    which = np.flatnonzero(count > 0)
    sums = np.concatenate([np.zeros((1, 4)), np.cumsum(told.astype(np.float64), axis=0)])
    said = sums[first[which] + count[which]] - sums[first[which]]
    heard = said[:, 3] > 1e-3
    which, said = which[heard], said[heard]
    if not len(which):
        return
    wanted = said[:, :3] / said[:, 3:] @ camera[:ORIGIN].reshape(3, 3).astype(np.float64)
    normal = normals_of(cloud.params[which])
    # A normal and its opposite are one plane.
    wanted *= np.where((wanted * normal).sum(axis=1, keepdims=True) < 0.0, -1.0, 1.0)
    turn = 0.5 * settings.align * np.cross(normal, wanted)
    step = np.concatenate([np.ones((len(turn), 1)), turn], axis=1)
    part = slice(QUATERNION, QUATERNION + 4)
    cloud.params[which, part] = quaternion_normalize(quaternion_multiply(step, directed(cloud.params[which])))


def depth_normals(
    depth: NDArray[np.float32], opacity: NDArray[np.float32], lens: Pinhole
) -> NDArray[np.float32]:
    """float32 (H, W, 4): unit normals in camera axes of the surface that ``depth`` (H, W) shows, turned to
    the camera, and 1 where they are sure: within the picture, where it is solid and not at an edge."""
    rays = lens.rays()
    points = rays * depth[..., None]
    out = np.zeros((*depth.shape, 4), np.float32)
    right, down = points[1:-1, 2:] - points[1:-1, :-2], points[2:, 1:-1] - points[:-2, 1:-1]
    normal = np.cross(down, right)
    length = np.linalg.norm(normal, axis=-1)
    around = np.stack([depth[1:-1, 2:], depth[1:-1, :-2], depth[2:, 1:-1], depth[:-2, 1:-1]])
    middle = depth[1:-1, 1:-1]
    sure = (opacity[1:-1, 1:-1] > SURE_OPACITY) & (middle > 0) & (around.min(axis=0) > 0) & (length > 0)
    sure &= np.ptp(around, axis=0) < JUMP * middle
    normal = normal / np.where(length > 0, length, 1.0)[..., None]
    normal *= np.where((normal * rays[1:-1, 1:-1]).sum(axis=-1, keepdims=True) > 0, -1.0, 1.0)
    out[1:-1, 1:-1, :3] = np.where(sure[..., None], normal, 0.0)
    out[1:-1, 1:-1, 3] = sure
    return out
