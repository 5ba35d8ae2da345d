"""Fusing one depth map into the blocks of a truncated signed distance grid (thesis 3.8-3.10)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.surface import surface_constants as tuned
from edge_server.surface.kernels.lens import distort

SIDE = 8  # voxels per side of a block
CELLS = SIDE**3
FAR = 1e9  # meters; interpolating infinity would give NaN


class KernelDepth(NamedTuple):
    """One depth map as the kernel reads it.

    lens: float64 (8,), fx fy cx cy k1 k2 p1 p2.
    rotation: float64 (3, 3), camera-to-world. origin: float64 (3,), meters.
    depth: float32 (H, W), meters along the ray, 0 where unknown, FAR where the ray meets nothing.
    trust: float32 (H, W), w_new of (3.9). cosine: float32 (H, W), between ray and normal.
    color: uint8 (H, W, 3).
    """

    lens: NDArray[np.float64]
    rotation: NDArray[np.float64]
    origin: NDArray[np.float64]
    depth: NDArray[np.float32]
    trust: NDArray[np.float32]
    cosine: NDArray[np.float32]
    color: NDArray[np.uint8]


class Blocks(NamedTuple):
    """B blocks of SIDE^3 voxels, x slowest.

    place: int32 (B, 3), position of each block in the grid, in blocks.
    lowest: float64 (3,), center of voxel (0, 0, 0), meters.
    distance, weight: float32 (B, CELLS), meters and weights of (3.9) and (3.10).
    color: float32 (B, CELLS, 4), sums of weighted colors in [0, 255] and of their weights.
    """

    place: NDArray[np.int32]
    lowest: NDArray[np.float64]
    distance: NDArray[np.float32]
    weight: NDArray[np.float32]
    color: NDArray[np.float32]


@njit(inline="always")
def _depth_at(depth, u, v, band):
    """Depth at image point (u, v): bilinear if the four pixels are one surface, else nearest; 0: none."""
    height, width = depth.shape
    near = np.float64(depth[np.int64(v), np.int64(u)])
    if not near > 0.0:
        return 0.0
    x0, y0 = np.int64(np.floor(u - 0.5)), np.int64(np.floor(v - 0.5))
    if x0 < 0 or y0 < 0 or x0 + 1 >= width or y0 + 1 >= height:
        return near
    d00, d01 = np.float64(depth[y0, x0]), np.float64(depth[y0, x0 + 1])
    d10, d11 = np.float64(depth[y0 + 1, x0]), np.float64(depth[y0 + 1, x0 + 1])
    low, high = min(min(d00, d01), min(d10, d11)), max(max(d00, d01), max(d10, d11))
    if not low > 0.0 or high - low > tuned.CLOSE * band:
        return near
    fx, fy = u - 0.5 - x0, v - 0.5 - y0
    return (d00 * (1.0 - fx) + d01 * fx) * (1.0 - fy) + (d10 * (1.0 - fx) + d11 * fx) * fy


@njit(inline="always")
def _row(depths, k):
    return depths.rotation[k, 0], depths.rotation[k, 1], depths.rotation[k, 2]


@kernel
def fuse(counter, worker, blocks, depths, voxel_m, band_m):
    """Fuse ``depths`` into all voxels it observes. Tasks are blocks, so the order of a voxel's sums does not
    depend on the number of workers. band_m: d_max of (3.8).

    A voxel's distance is that along its ray times the cosine at the surface: the distance to the plane there.
    Voxels more than band_m behind a surface are hidden and do not change; the weight falls to 0 over that
    range, so that views of a thin part's front do not push out its back. Voxels more than band_m before a
    surface have weight FREE: enough to remove a surface that only one camera sees, too little for passing
    rays to pull a round surface inwards.
    """
    height, width = depths.depth.shape
    f_width, f_height = np.float64(width), np.float64(height)
    # Copy to locals: the compiler must assume that writes to the blocks may alias the camera.
    (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = _row(depths, 0), _row(depths, 1), _row(depths, 2)
    ox, oy, oz = depths.origin[0], depths.origin[1], depths.origin[2]
    fx, fy, cx, cy = depths.lens[0], depths.lens[1], depths.lens[2], depths.lens[3]
    distorted = depths.lens[4] != 0.0 or depths.lens[5] != 0.0 or depths.lens[6] != 0.0 or depths.lens[7] != 0.0
    half = 0.5 * (SIDE - 1) * voxel_m
    while True:
        b = fetch_add(counter, 1)
        if b >= blocks.place.shape[0]:
            return
        x0 = blocks.lowest[0] + voxel_m * (SIDE * blocks.place[b, 0]) - ox
        y0 = blocks.lowest[1] + voxel_m * (SIDE * blocks.place[b, 1]) - oy
        z0 = blocks.lowest[2] + voxel_m * (SIDE * blocks.place[b, 2]) - oz
        # Skip a block wholly behind the camera, or outside the frustum of an undistorted lens.
        x, y, z = x0 + half, y0 + half, z0 + half
        ball = np.sqrt(3.0) * half
        deep = r02 * x + r12 * y + r22 * z
        if deep < -ball:
            continue
        if not distorted and deep > 2.0 * ball:
            u, v = (fx * (r00 * x + r10 * y + r20 * z) / deep + cx, fy * (r01 * x + r11 * y + r21 * z) / deep + cy)
            reach = 2.0 * ball * (fx + fy) / (deep - ball)
            if u < -reach or v < -reach or u > f_width + reach or v > f_height + reach:
                continue
        for k in range(CELLS):
            x = x0 + voxel_m * (k // (SIDE * SIDE))
            y = y0 + voxel_m * (k // SIDE % SIDE)
            z = z0 + voxel_m * (k % SIDE)
            deep = r02 * x + r12 * y + r22 * z
            if not deep > 1e-6:
                continue
            over = 1.0 / deep
            u, v = (r00 * x + r10 * y + r20 * z) * over, (r01 * x + r11 * y + r21 * z) * over
            if distorted:
                u, v = distort(u, v, depths.lens[4], depths.lens[5], depths.lens[6], depths.lens[7])
            u, v = fx * u + cx, fy * v + cy
            if not (u >= 0.0 and v >= 0.0 and u < f_width and v < f_height):
                continue
            depth = _depth_at(depths.depth, u, v, band_m)
            if not depth > 0.0:
                continue
            row, column = np.int64(v), np.int64(u)
            new = np.float64(depths.trust[row, column])
            along = depth - np.sqrt(x * x + y * y + z * z)
            if not (along > -band_m and new > 0.0):
                continue
            ahead = along * depths.cosine[row, column]
            new *= min(1.0, 1.0 + along / band_m)
            old = np.float64(blocks.weight[b, k])
            clipped = min(ahead, band_m)
            if ahead >= band_m:
                new *= tuned.FREE
            blocks.distance[b, k] = (old * blocks.distance[b, k] + new * clipped) / (old + new)
            blocks.weight[b, k] = old + new
            if ahead < band_m:
                for c in range(3):
                    blocks.color[b, k, c] += new * depths.color[row, column, c]
                blocks.color[b, k, 3] += new
