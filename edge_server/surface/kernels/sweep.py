"""Photo-consistent depth: plane sweep along each pixel's ray to where other images agree best.

The plane has the current surface normal. An affine approximation of the projection maps its patch of TAPS x
TAPS pixels to another image. The score is zero-mean normalized cross-correlation, invariant to exposure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add

TAPS = 5  # pixels per side of a patch
REACH = TAPS // 2
FLAT = 0.25  # minimum variance, gray levels squared, of a textured patch
NONE = -2.0  # score of a point that no other image shows


class SourceImages(NamedTuple):
    """S pictures to compare with. lens: float64 (S, 8), fx fy cx cy k1 k2 p1 p2. rotation: (S, 3, 3),
    camera-to-world; origin: (S, 3), metres. first: int64 (S + 1,) into grey: float32 (P,), row by row;
    size: int64 (S, 2), width and height."""

    lens: NDArray[np.float64]
    rotation: NDArray[np.float64]
    origin: NDArray[np.float64]
    first: NDArray[np.int64]
    size: NDArray[np.int64]
    grey: NDArray[np.float32]


@njit(inline="always")
def _project(others, s, x, y, z):
    """Project a world point to image s; -1e9 if behind the camera or far outside."""
    x, y, z = x - others.origin[s, 0], y - others.origin[s, 1], z - others.origin[s, 2]
    r, lens = others.rotation, others.lens
    deep = r[s, 0, 2] * x + r[s, 1, 2] * y + r[s, 2, 2] * z
    if not deep > 1e-6:
        return -1e9, -1e9
    a = (r[s, 0, 0] * x + r[s, 1, 0] * y + r[s, 2, 0] * z) / deep
    b = (r[s, 0, 1] * x + r[s, 1, 1] * y + r[s, 2, 1] * z) / deep
    k1, k2, p1, p2 = lens[s, 4], lens[s, 5], lens[s, 6], lens[s, 7]
    r2 = a * a + b * b
    radial = 1.0 + r2 * (k1 + r2 * k2)
    if not (radial > 0.0 and r2 < 16.0):
        return -1e9, -1e9
    u = a * radial + 2.0 * p1 * a * b + p2 * (r2 + 2.0 * a * a)
    v = b * radial + p1 * (r2 + 2.0 * b * b) + 2.0 * p2 * a * b
    return lens[s, 0] * u + lens[s, 2], lens[s, 1] * v + lens[s, 3]


@njit(inline="always")
def _on_plane(rays, row, column, nx, ny, nz, reach):
    """Distance from the camera along a pixel's ray to the plane n p = reach; 0: no intersection."""
    along = nx * rays[row, column, 0] + ny * rays[row, column, 1] + nz * rays[row, column, 2]
    return reach / along if abs(along) > 1e-3 else 0.0


@njit
def correlation(patch, spread, others, s, u, v, ux, vx, uy, vy):
    """Correlation of ``patch`` (TAPS^2, its mean taken off, ``spread`` its squared length) with picture s
    around (u, v), where a pixel to the right is (ux, vx) and one down (uy, vy); NONE: outside."""
    width, height, first = others.size[s, 0], others.size[s, 1], others.first[s]
    u, v = u - 0.5, v - 0.5
    far_u, far_v = REACH * (abs(ux) + abs(uy)), REACH * (abs(vx) + abs(vy))
    if not (u - far_u >= 0.0 and v - far_v >= 0.0 and u + far_u < width - 1 and v + far_v < height - 1):
        return NONE
    total = square = cross = np.float32(0.0)
    k = 0
    for j in range(-REACH, REACH + 1):
        for i in range(-REACH, REACH + 1):
            a, b = np.float32(u + i * ux + j * uy), np.float32(v + i * vx + j * vy)
            x, y = np.int32(a), np.int32(b)
            fa, fb = a - np.float32(x), b - np.float32(y)
            at = first + y * width + x
            top = others.grey[at] + fa * (others.grey[at + 1] - others.grey[at])
            low = others.grey[at + width] + fa * (others.grey[at + width + 1] - others.grey[at + width])
            g = top + fb * (low - top)
            total += g
            square += g * g
            cross += patch[k] * g
            k += 1
    other = square - total * total / np.float32(TAPS * TAPS)
    if other < np.float32(FLAT * TAPS * TAPS):
        return 0.0
    return np.float64(cross / np.sqrt(spread * other))


@kernel
def sweep(counter, worker, rays, origin, grey, depth, normal, others, factors, best_depth, best_score):
    """For every pixel with a depth, the factor of it at which the others agree best. Tasks are rows.

    rays: float64 (H, W, 3), world; origin: (3,). grey, depth: float32 (H, W). normal: float32 (H, W, 3),
    world. factors: float64 (K,), rising evenly around 1, odd in number. best_depth: float32 (H, W), between
    two factors by a parabola; best_score: (H, W), mean correlation of the two pictures that agree best, 0
    where a patch tells nothing, NONE where it cannot be compared. Both are written.
    """
    height, width = depth.shape
    patch = np.empty(TAPS * TAPS, np.float32)
    scores = np.empty(factors.size)
    while True:
        row = fetch_add(counter, 1)
        if row >= height:
            return
        for column in range(width):
            d0 = np.float64(depth[row, column])
            best_depth[row, column], best_score[row, column] = depth[row, column], np.float32(NONE)
            inside = row >= REACH and column >= REACH and row < height - REACH and column < width - REACH
            if not (d0 > 0.0 and d0 < 1e8 and inside):
                continue
            mean = np.float32(0.0)
            for j in range(TAPS):
                for i in range(TAPS):
                    g = grey[row + j - REACH, column + i - REACH]
                    patch[j * TAPS + i] = g
                    mean += g
            mean /= np.float32(TAPS * TAPS)
            spread = np.float32(0.0)
            for k in range(TAPS * TAPS):
                patch[k] -= mean
                spread += patch[k] * patch[k]
            if spread < np.float32(FLAT * TAPS * TAPS):
                best_score[row, column] = 0.0
                continue
            rx, ry, rz = rays[row, column, 0], rays[row, column, 1], rays[row, column, 2]
            nx, ny, nz = (
                np.float64(normal[row, column, 0]),
                np.float64(normal[row, column, 1]),
                np.float64(normal[row, column, 2]),
            )
            along = nx * rx + ny * ry + nz * rz
            if not abs(along) > 0.1:
                continue
            # Where the plane at distance 1 meets the rays one pixel to the right and one down.
            right = _on_plane(rays, row, column + 1, nx, ny, nz, along)
            down = _on_plane(rays, row + 1, column, nx, ny, nz, along)
            top, at = NONE, -1
            for k in range(factors.size):
                d = d0 * factors[k]
                one = two = NONE
                for s in range(others.first.size - 1):
                    u, v = _project(others, s, origin[0] + d * rx, origin[1] + d * ry, origin[2] + d * rz)
                    if u < 0.0 or v < 0.0 or u >= others.size[s, 0] or v >= others.size[s, 1]:
                        continue
                    a, b = d * right, d * down
                    ur, vr = _project(
                        others, s, origin[0] + a * rays[row, column + 1, 0],
                        origin[1] + a * rays[row, column + 1, 1], origin[2] + a * rays[row, column + 1, 2],
                    )  # fmt: skip
                    ud, vd = _project(
                        others, s, origin[0] + b * rays[row + 1, column, 0],
                        origin[1] + b * rays[row + 1, column, 1], origin[2] + b * rays[row + 1, column, 2],
                    )  # fmt: skip
                    found = correlation(patch, spread, others, s, u, v, ur - u, vr - v, ud - u, vd - v)
                    if found > one:
                        one, two = found, one
                    elif found > two:
                        two = found
                scores[k] = 0.5 * (one + two) if two > NONE else one
                if scores[k] > top:
                    top, at = scores[k], k
            best_score[row, column] = top
            if at < 0:
                continue
            shift = 0.0
            if at > 0 and at < factors.size - 1 and scores[at - 1] > NONE and scores[at + 1] > NONE:
                bend = scores[at - 1] - 2.0 * scores[at] + scores[at + 1]
                if bend < -1e-9:
                    shift = 0.5 * (scores[at - 1] - scores[at + 1]) / bend
            step = factors[1] - factors[0] if factors.size > 1 else 0.0
            best_depth[row, column] = np.float32(d0 * (factors[at] + step * min(max(shift, -0.5), 0.5)))
