"""Projection of Gaussians to the image plane (Kerbl et al. 2023, after Zwicker et al. 2001).

Everything is in scene units and float32. Lens distortion is part of the projection: the mean is distorted,
and the covariance is projected by the Jacobian of the distorted projection. Images therefore need no
undistortion at intake, and any camera can be rendered.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.camera import LENS, NEAR, ORIGIN, SIZE, lens_terms, load_camera, rotate_to_camera
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import draw, exp32, is_finite, log32
from edge_server.fields.common.kernels.volume_rendering import harmonic
from edge_server.fields.splat.splat_constants import (
    ALPHA_MIN,
    LOG_SCALE_HIGH,
    LOG_SCALE_LOW,
    LOW_PASS,
    RAW_OPACITY_LIMIT,
)

# Columns of a Gaussian's parameters; from BASE on the SH_COLUMNS of the spherical harmonics of degree 1, three for
# each, or none.
POSITION, SCALE, QUATERNION, OPACITY, COLOR = 0, 3, 6, 10, 11
BASE, SH_COLUMNS = 14, 9
# Columns of a projected Gaussian.
MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, ALPHA, RED, DEPTH = 0, 1, 2, 3, 4, 5, 6, 9
RADIUS, HALF_HEIGHT, PROJECTED = 10, 11, 12
# Columns of a Gaussian's footprint: the box of tiles x0, x1, y0, y1 (x1 <= x0: empty); a bit for each of its
# first 64 tiles, x fastest, set where the Gaussian touches the tile (it is taken to touch the tiles beyond
# these); the depth as a sort key for ``bin_tiles``.
TILE_BITS, DEPTH_KEY, FOOTPRINT = 4, 6, 7

TILE = 8  # pixels a side
BLOCK = 128  # Gaussians a task

# The bits of positive float32 sort as the numbers do. From .01 to 1e5 scene units their upper 23 bits take
# 380 thousand values: the order of Gaussians whose depths differ by less than a share of 6e-5 is arbitrary.
DEPTH_BITS = 20
_NEAREST_BITS, _DROPPED_BITS = (np.int32(0x3C23D70A), np.int32(9))  # the bits of .01; lower bits that are left out

FAR = 1e5  # scene units: beyond it float32 squares lose their meaning
_NO_DIRECTION = 1e-20  # squared length below which a quaternion has no direction

# Rows of BLOCK numbers, in which a block of Gaussians is projected side by side.
_X, _M, _ALPHA, _REACH, _Q, _S = (n * BLOCK for n in (0, 3, 12, 13, 14, 18))
_PX, _PY, _PZ, _A, _B, _C, _WIDE, _HIGH, _LEFT, _RIGHT, _TOP, _BOTTOM = (n * BLOCK for n in range(14, 26))
_ROWS = 26

_F0, _F1, _F2, _HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)


@device_function
def unit_quaternion(w, x, y, z):
    """The normalized quaternion and 1 / length; (1, 0, 0, 0) and 0 for one without a direction."""
    square = w * w + x * x + y * y + z * z
    has = (square > np.float32(_NO_DIRECTION)) & (square < np.float32(1e20))
    inverse = _F1 / np.sqrt(square if has else _F1)
    return (
        w * inverse if has else _F1,
        x * inverse if has else _F0,
        y * inverse if has else _F0,
        z * inverse if has else _F0,
        inverse if has else _F0,
    )


@device_function
def rotation(w, x, y, z):
    """The rotation matrix of a unit quaternion, row by row."""
    return (
        _F1 - _F2 * (y * y + z * z),
        _F2 * (x * y - w * z),
        _F2 * (x * z + w * y),
        _F2 * (x * y + w * z),
        _F1 - _F2 * (x * x + z * z),
        _F2 * (y * z - w * x),
        _F2 * (x * z - w * y),
        _F2 * (y * z + w * x),
        _F1 - _F2 * (x * x + y * y),
    )


@device_function
def exp_scale(raw):
    """The scale of a raw parameter, which is clamped first."""
    return exp32(min(max(raw, np.float32(LOG_SCALE_LOW)), np.float32(LOG_SCALE_HIGH)))


@device_function
def rotate_to_world(cam, j0, j1, j2):
    """A row vector in camera axes -> in world axes."""
    return (
        j0 * cam[0] + j1 * cam[3] + j2 * cam[6],
        j0 * cam[1] + j1 * cam[4] + j2 * cam[7],
        j0 * cam[2] + j1 * cam[5] + j2 * cam[8],
    )


@device_function
def _load_block(params, base, count, s):
    """Load Gaussians base, ..., base + count - 1 into the rows of ``s``: position, axes of the ellipsoid times their
    lengths, opacity, and the Gaussian's extent in standard deviations squared (0: invisible)."""
    for j in range(count):
        i = base + j
        for k in range(3):
            s[_X + k * BLOCK + j] = params[i, k]
            s[_S + k * BLOCK + j] = params[i, SCALE + k]
        for k in range(4):
            s[_Q + k * BLOCK + j] = params[i, QUATERNION + k]
        s[_ALPHA + j] = params[i, OPACITY]
    for j in range(BLOCK):
        w, x, y, z, _ = unit_quaternion(s[_Q + j], s[_Q + BLOCK + j], s[_Q + 2 * BLOCK + j], s[_Q + 3 * BLOCK + j])
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation(w, x, y, z)
        s0, s1, s2 = exp_scale(s[_S + j]), exp_scale(s[_S + BLOCK + j]), exp_scale(s[_S + 2 * BLOCK + j])
        s[_M + j], s[_M + BLOCK + j], s[_M + 2 * BLOCK + j] = r0 * s0, r1 * s1, r2 * s2
        s[_M + 3 * BLOCK + j], s[_M + 4 * BLOCK + j], s[_M + 5 * BLOCK + j] = r3 * s0, r4 * s1, r5 * s2
        s[_M + 6 * BLOCK + j], s[_M + 7 * BLOCK + j], s[_M + 8 * BLOCK + j] = r6 * s0, r7 * s1, r8 * s2
        raw = s[_ALPHA + j]
        alpha = _F1 / (_F1 + exp32(-min(max(raw, np.float32(-RAW_OPACITY_LIMIT)), np.float32(RAW_OPACITY_LIMIT))))
        shows = is_finite(raw) & (alpha > np.float32(ALPHA_MIN))
        s[_ALPHA + j] = alpha
        s[_REACH + j] = _F2 * log32(alpha * np.float32(1.0 / ALPHA_MIN)) if shows else _F0


@device_function
def _project_block(cam, s):
    """Project the Gaussians in the rows of ``s`` into a camera: mean, depth, conic, and the edges of the box
    they cover, in tiles (LEFT > RIGHT: not in the image). cam: see ``load_camera``."""
    fx, fy, width, height = cam[LENS], cam[LENS + 1], cam[SIZE], cam[SIZE + 1]
    low, over = np.float32(LOW_PASS), np.float32(1.0 / TILE)
    for j in range(BLOCK):
        x, y, z = rotate_to_camera(
            cam, s[_X + j] - cam[ORIGIN], s[_X + BLOCK + j] - cam[ORIGIN + 1], s[_X + 2 * BLOCK + j] - cam[ORIGIN + 2]
        )
        shows = (z > cam[NEAR]) & (z < np.float32(FAR)) & (s[_REACH + j] > _F0)
        _, _, ta, tc, u, v, dxx, dxy, dyy, _, _, _, _, inverse = lens_terms(cam, x, y, z if shows else _F1)
        gx, gy = fx * inverse, fy * inverse
        t0, t1, t2 = rotate_to_world(cam, gx * dxx, gx * dxy, -gx * (dxx * ta + dxy * tc))
        t3, t4, t5 = rotate_to_world(cam, gy * dxy, gy * dyy, -gy * (dxy * ta + dyy * tc))
        m0, m1, m2 = s[_M + j], s[_M + BLOCK + j], s[_M + 2 * BLOCK + j]
        m3, m4, m5 = s[_M + 3 * BLOCK + j], s[_M + 4 * BLOCK + j], s[_M + 5 * BLOCK + j]
        m6, m7, m8 = s[_M + 6 * BLOCK + j], s[_M + 7 * BLOCK + j], s[_M + 8 * BLOCK + j]
        v0, v1, v2 = t0 * m0 + t1 * m3 + t2 * m6, t0 * m1 + t1 * m4 + t2 * m7, t0 * m2 + t1 * m5 + t2 * m8
        w0, w1, w2 = t3 * m0 + t4 * m3 + t5 * m6, t3 * m1 + t4 * m4 + t5 * m7, t3 * m2 + t4 * m5 + t5 * m8
        # The covariance is V V^T + low-pass: symmetric, and its determinant a sum of squares by Lagrange's
        # identity, which a difference of products would lose for needles.
        e, g = v0 * v0 + v1 * v1 + v2 * v2, w0 * w0 + w1 * w1 + w2 * w2
        n0, n1, n2 = v1 * w2 - v2 * w1, v2 * w0 - v0 * w2, v0 * w1 - v1 * w0
        determinant = max(n0 * n0 + n1 * n1 + n2 * n2 + low * (e + g) + low * low, np.float32(1e-10))
        e, g, f = e + low, g + low, v0 * w0 + v1 * w1 + v2 * w2
        px, py = fx * u + cam[LENS + 2], fy * v + cam[LENS + 3]
        shows = shows & is_finite(determinant) & (abs(px) + abs(py) < np.float32(1e6)) & is_finite(e + g)
        rx, ry = np.sqrt(s[_REACH + j] * e), np.sqrt(s[_REACH + j] * g)
        shows = shows & (px + rx > _F0) & (px - rx < width) & (py + ry > _F0) & (py - ry < height)
        inv = _F1 / determinant
        s[_PX + j], s[_PY + j], s[_PZ + j] = px, py, z
        s[_A + j], s[_B + j], s[_C + j] = g * inv, -f * inv, e * inv
        s[_WIDE + j], s[_HIGH + j] = np.sqrt(max(e, g)), ry
        s[_LEFT + j] = max(px - rx, _F0) * over if shows else _F1
        s[_RIGHT + j] = min(px + rx, width - _HALF) * over if shows else -_F1
        s[_TOP + j], s[_BOTTOM + j] = max(py - ry, _F0) * over, min(py + ry, height - _HALF) * over


@device_function
def _touched_tiles(px, py, a, b, c, reach, x0, x1, y0, y1):
    """Bits of the tiles of a box that an ellipse touches: those in which a dx^2 + 2 b dx dy + c dy^2 is at
    most ``reach`` somewhere. The box of a slanting needle is twice as large as its ellipse, and a tile that
    the ellipse misses would cost as much as one that it touches."""
    bits, bit = np.uint64(0), np.uint64(0)
    most = reach * np.float32(1.001) + np.float32(1e-3)
    slope_x, slope_y = -b / a, -b / c
    for ty in range(y0, y1):
        # From the mean to the centers of the tile's outermost pixels.
        low_y = np.float32(TILE * ty) + _HALF - py
        high_y = low_y + np.float32(TILE - 1)
        dy = max(low_y, min(high_y, _F0))
        for tx in range(x0, x1):
            low_x = np.float32(TILE * tx) + _HALF - px
            high_x = low_x + np.float32(TILE - 1)
            dx = max(low_x, min(high_x, _F0))
            # The minimum over a rectangle lies on one of the two edges that face the mean.
            ex, ey = min(max(slope_x * dy, low_x), high_x), min(max(slope_y * dx, low_y), high_y)
            least = min(a * ex * ex + (b + b) * ex * dy + c * dy * dy, a * dx * dx + (b + b) * dx * ey + c * ey * ey)
            if least <= most:
                bits |= np.uint64(1) << bit
            bit += np.uint64(1)
            if bit == np.uint64(64):
                return bits
    return bits


@device_function
def _write_projected(cam, params, i, s, j, row, edges):
    """Fill row (PROJECTED,) and edges (FOOTPRINT,) of Gaussian i from column j of ``s``. The conic is the
    upper triangle of the inverse of the projected covariance."""
    row[MEAN_X], row[MEAN_Y], row[DEPTH] = s[_PX + j], s[_PY + j], s[_PZ + j]
    row[CONIC_A], row[CONIC_B], row[CONIC_C] = s[_A + j], s[_B + j], s[_C + j]
    row[ALPHA], row[RADIUS], row[HALF_HEIGHT] = s[_ALPHA + j], s[_WIDE + j], s[_HIGH + j]
    for k in range(3):
        row[RED + k] = params[i, COLOR + k]
    if params.shape[1] > BASE:
        ox, oy, oz = params[i, 0] - cam[ORIGIN], params[i, 1] - cam[ORIGIN + 1], (params[i, 2] - cam[ORIGIN + 2])
        length = _F1 / max(np.sqrt(ox * ox + oy * oy + oz * oz), np.float32(1e-9))
        ox, oy, oz = ox * length, oy * length, oz * length
        for h in range(1, 4):
            value = harmonic(h, ox, oy, oz)
            for k in range(3):
                row[RED + k] += value * params[i, BASE + 3 * (h - 1) + k]
    if is_finite(row[RED] + row[RED + 1] + row[RED + 2]):
        edges[0], edges[1] = np.int32(s[_LEFT + j]), np.int32(s[_RIGHT + j]) + 1
        edges[2], edges[3] = np.int32(s[_TOP + j]), np.int32(s[_BOTTOM + j]) + 1
        bits = _touched_tiles(
            row[MEAN_X],
            row[MEAN_Y],
            row[CONIC_A],
            row[CONIC_B],
            row[CONIC_C],
            s[_REACH + j],
            edges[0],
            edges[1],
            edges[2],
            edges[3],
        )
        far = (np.float32(row[DEPTH]).view(np.int32) - _NEAREST_BITS) >> _DROPPED_BITS
        edges[DEPTH_KEY] = min(max(far, np.int32(0)), np.int32((1 << DEPTH_BITS) - 1))
        edges[TILE_BITS] = np.int32(bits & np.uint64(0xFFFFFFFF))
        edges[TILE_BITS + 1] = np.int32(bits >> np.uint64(32))


@kernel
def project(counter, worker, camera, params, count, projected, tiles):
    """Project all Gaussians into a camera. Tasks are blocks of Gaussians.

    camera: float32 (1, CAMERA).
    params: float32 (>= count, BASE or BASE + SH_COLUMNS), of which the first ``count`` are projected.
    projected: float32 (>= count, PROJECTED), written where a Gaussian is in the image.
    tiles: int32 (>= count, FOOTPRINT), written.
    """
    cam, s = load_camera(camera, 0), np.zeros(_ROWS * BLOCK, np.float32)
    while True:
        base = draw(counter, worker, (count + BLOCK - 1) // BLOCK) * BLOCK
        if base >= count:
            return
        here = min(BLOCK, count - base)
        _load_block(params, base, here, s)
        _project_block(cam, s)
        for j in range(here):
            i = base + j
            edges = tiles[i]
            edges[0] = edges[1] = edges[2] = edges[3] = 0
            if s[_LEFT + j] <= s[_RIGHT + j]:
                _write_projected(cam, params, i, s, j, projected[i], edges)
