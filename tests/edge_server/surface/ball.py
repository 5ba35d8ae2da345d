"""Exact depth of a ball, and a fused volume worked out voxel by voxel in plain numpy."""

import numpy as np
from numpy.typing import NDArray

from edge_server.surface.depth import DepthMap, depth_map
from edge_server.surface.kernels.fuse import FAR, SIDE
from edge_server.surface.surface_constants import CLOSE, FREE
from edge_server.surface.volume import Grid, Volume
from freshfield.geometry import Pinhole, look_at, world_rays

RADIUS_M = 0.1
LENS = Pinhole.from_fov(64, 64, 40.0)
DISTORTED_LENS = Pinhole(64, 64, 88.0, 87.0, 31.0, 33.0, (-0.2, 0.05, 0.002, -0.001))
TILTED_LENS = Pinhole(64, 64, 88.0, 87.0, 31.0, 33.0, (0.0, 0.0, 0.0, -0.02))


def ball_maps(count: int = 20, camera: Pinhole = LENS) -> list[DepthMap]:
    """A ball seen from all sides (a Fibonacci spiral of cameras), gray with a red upper half."""
    k, maps = np.arange(count) + 0.5, []
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    for eye in 0.4 * np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=-1):
        pose = look_at(eye, (0, 0, 0))
        origin, rays = world_rays(camera, pose)
        along = rays @ origin
        root = along * along - (origin @ origin - RADIUS_M**2)
        depth = np.where(root > 0, -along - np.sqrt(np.maximum(root, 0)), np.inf).astype(np.float32)
        up = (origin + rays * np.where(np.isfinite(depth), depth, 0)[..., None])[..., 2] > 0
        color = np.where(up[..., None], np.array([200, 20, 20]), 90).astype(np.uint8)
        maps.append(depth_map(depth, color, pose, camera))
    return maps


def voxel_points(volume: Volume) -> NDArray:
    """World places (blocks, voxels of a block, 3) of a volume's voxels."""
    cell = np.arange(SIDE**3)
    inside = np.stack([cell // SIDE**2, cell // SIDE % SIDE, cell % SIDE], axis=-1)
    grid = volume.grid
    return np.array(grid.lower) + grid.voxel_m * (SIDE * volume.blocks.place[:, None] + inside)


def plain_fuse(grid: Grid, maps: list[DepthMap], points: NDArray) -> tuple[NDArray, NDArray]:
    """Distances and weights (N,) of (3.8)-(3.10) at points (N, 3), one map after the other."""
    distance, weight = np.full(len(points), grid.band_m), np.zeros(len(points))
    for m in maps:
        pose, lens = m.camera_to_world, m.intrinsics
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        far = np.linalg.norm(local, axis=1)
        for n in range(len(points)):
            if local[n, 2] <= 1e-6:
                continue
            u, v = lens.project(local[n])
            if not (0 <= u < lens.width and 0 <= v < lens.height):
                continue
            depth = _between(np.where(np.isfinite(m.depth), m.depth, FAR), u, v, grid.band_m)
            along, new = depth - far[n], float(m.trust[int(v), int(u)])
            if depth <= 0 or along <= -grid.band_m or new <= 0:
                continue
            ahead = along * float(m.cosine[int(v), int(u)])
            new *= min(1.0, 1.0 + along / grid.band_m) * (FREE if ahead >= grid.band_m else 1.0)
            distance[n] = (weight[n] * distance[n] + new * min(ahead, grid.band_m)) / (weight[n] + new)
            weight[n] += new
    return distance, weight


def _between(depth: NDArray, u: float, v: float, band: float) -> float:
    near = float(depth[int(v), int(u)])
    x, y = int(np.floor(u - 0.5)), int(np.floor(v - 0.5))
    if near <= 0 or x < 0 or y < 0 or x + 1 >= depth.shape[1] or y + 1 >= depth.shape[0]:
        return near
    four = depth[y : y + 2, x : x + 2].astype(float)
    if four.min() <= 0 or np.ptp(four) > CLOSE * band:
        return near
    a, b = u - 0.5 - x, v - 0.5 - y
    return float((four[0] @ [1 - a, a]) * (1 - b) + (four[1] @ [1 - a, a]) * b)
