"""The gradient of ``project``: from the sums over a Gaussian's pixels to its parameters, block by block.

As in ``project``, a block is a set of rows of BLOCK numbers in one piece of memory, so that LLVM vectorizes
every line over its Gaussians. Gaussians that the camera does not see are computed too, and masked at the end.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.camera import LENS, ORIGIN, lens_terms, rotate_to_camera
from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.common.kernels.volume_rendering import SH_C1, harmonic
from edge_server.fields.splat.kernels.project import (
    ALPHA,
    BASE,
    BLOCK,
    COLOR,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    OPACITY,
    QUATERNION,
    SCALE,
    exp_scale,
    rotate_to_world,
    rotation,
    unit_quaternion,
)
from edge_server.fields.splat.splat_constants import LOG_SCALE_HIGH, LOG_SCALE_LOW, RAW_OPACITY_LIMIT

# Rows of BLOCK numbers: position, raw scale, quaternion, raw opacity; then as projected: opacity, conic, sums over
# pairs, whether there are any pairs, and the length of the gradient by the projected mean; from GRADIENT on, a row for
# each parameter's gradient.
_X, _S, _Q, _RAW, _ALPHA, _QA, _QB, _QC, SUM = (n * BLOCK for n in (0, 3, 6, 10, 11, 12, 13, 14, 15))
SEEN, SLOPE, GRADIENT = (n * BLOCK for n in (24, 25, 26))
_ROWS = 26

_F0, _F1, _F2, _HALF = np.float32(0.0), np.float32(1.0), np.float32(2.0), np.float32(0.5)


@device_function
def block_scratch(width):
    """Memory for a block of Gaussians with ``width`` parameters each."""
    return np.zeros((_ROWS + width) * BLOCK, np.float32)


@device_function
def load_block(params, base, count, s):
    """Load Gaussians base, ..., base + count - 1 into the rows of ``s`` and set their gradients to 0."""
    for j in range(count):
        i = base + j
        for k in range(3):
            s[_X + k * BLOCK + j] = params[i, k]
            s[_S + k * BLOCK + j] = params[i, SCALE + k]
        for k in range(4):
            s[_Q + k * BLOCK + j] = params[i, QUATERNION + k]
        s[_RAW + j] = params[i, OPACITY]
    for k in range(GRADIENT, GRADIENT + params.shape[1] * BLOCK):
        s[k] = _F0


@device_function
def gather_sums(base, count, projected, lists, pair_sums, s):
    """Add up the sums of each Gaussian's pairs, in a fixed order. Returns how many Gaussians of the block have some."""
    seen = 0
    for j in range(count):
        i = base + j
        first, pairs = np.int64(lists.own_first[i]), np.int64(lists.own_count[i])
        s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = _F0
        for p in range(first, first + pairs):
            row = pair_sums[p]
            s0, s1, s2, s3, s4 = s0 + row[0], s1 + row[1], s2 + row[2], s3 + row[3], s4 + row[4]
            s5, s6, s7, s8 = s5 + row[5], s6 + row[6], s7 + row[7], s8 + row[8]
        for k, value in enumerate((s0, s1, s2, s3, s4, s5, s6, s7, s8)):
            s[SUM + k * BLOCK + j] = value
        row = projected[i]
        s[_ALPHA + j] = row[ALPHA]
        s[_QA + j], s[_QB + j], s[_QC + j] = row[CONIC_A], row[CONIC_B], row[CONIC_C]
        s[SEEN + j] = _F1 if pairs > 0 else _F0
        seen += np.int64(pairs > 0)
    for j in range(count, BLOCK):
        s[SEEN + j] = _F0
    return seen


@device_function
def project_backward(cam, s):
    """Add the gradients to the rows from GRADIENT on. cam: see ``load_camera``.

    The sums over the pixels that a Gaussian covers are: h = d loss / d power, h dx, h dy, h dx^2, h dx dy,
    h dy^2, with (dx, dy) from the mean to the pixel, and d loss / d color. Row SLOPE gets the length of the
    gradient by the projected mean (pixels), 0 where the Gaussian is not seen."""
    fx, fy = cam[LENS], cam[LENS + 1]
    for j in range(BLOCK):
        seen = s[SEEN + j] > _F0
        x, y, z = rotate_to_camera(
            cam, s[_X + j] - cam[ORIGIN], s[_X + BLOCK + j] - cam[ORIGIN + 1], s[_X + 2 * BLOCK + j] - cam[ORIGIN + 2]
        )
        a, c, ta, tc, _, _, dxx, dxy, dyy, xxx, xxy, xyy, yyy, inverse = lens_terms(cam, x, y, z if seen else _F1)
        gx, gy = fx * inverse, fy * inverse
        j0, j1, j2 = gx * dxx, gx * dxy, -gx * (dxx * ta + dxy * tc)
        j3, j4, j5 = gy * dxy, gy * dyy, -gy * (dxy * ta + dyy * tc)
        t0, t1, t2 = rotate_to_world(cam, j0, j1, j2)
        t3, t4, t5 = rotate_to_world(cam, j3, j4, j5)
        qw, qx, qy, qz, q_inverse = unit_quaternion(
            s[_Q + j], s[_Q + BLOCK + j], s[_Q + 2 * BLOCK + j], s[_Q + 3 * BLOCK + j]
        )
        r0, r1, r2, r3, r4, r5, r6, r7, r8 = rotation(qw, qx, qy, qz)
        raw0, raw1, raw2 = s[_S + j], s[_S + BLOCK + j], s[_S + 2 * BLOCK + j]
        s0, s1, s2 = exp_scale(raw0), exp_scale(raw1), exp_scale(raw2)
        v0, v1, v2 = (
            (t0 * r0 + t1 * r3 + t2 * r6) * s0,
            (t0 * r1 + t1 * r4 + t2 * r7) * s1,
            (t0 * r2 + t1 * r5 + t2 * r8) * s2,
        )
        w0, w1, w2 = (
            (t3 * r0 + t4 * r3 + t5 * r6) * s0,
            (t3 * r1 + t4 * r4 + t5 * r7) * s1,
            (t3 * r2 + t4 * r5 + t5 * r8) * s2,
        )
        # mean and conic
        qa, qb, qc = s[_QA + j], s[_QB + j], s[_QC + j]
        hx, hy = s[SUM + BLOCK + j], s[SUM + 2 * BLOCK + j]
        du, dv = qa * hx + qb * hy, qb * hx + qc * hy
        hxx, hxy, hyy = s[SUM + 3 * BLOCK + j], s[SUM + 4 * BLOCK + j], s[SUM + 5 * BLOCK + j]
        ga, gb, gc = -_HALF * hxx, -_HALF * hxy, -_HALF * hyy
        # d cov = - Q G Q
        m0, m1 = qa * ga + qb * gb, qa * gb + qb * gc
        m2, m3 = qb * ga + qc * gb, qb * gb + qc * gc
        e, f, g = -(m0 * qa + m1 * qb), -(m0 * qb + m1 * qc), -(m2 * qb + m3 * qc)
        # cov = V V^T
        a0, a1, a2 = _F2 * (e * v0 + f * w0), _F2 * (e * v1 + f * w1), _F2 * (e * v2 + f * w2)
        b0, b1, b2 = _F2 * (f * v0 + g * w0), _F2 * (f * v1 + g * w1), _F2 * (f * v2 + g * w2)
        low, high, bounded = np.float32(LOG_SCALE_LOW), np.float32(LOG_SCALE_HIGH), np.float32(RAW_OPACITY_LIMIT)
        d0, d1, d2 = a0 * v0 + b0 * w0, a1 * v1 + b1 * w1, a2 * v2 + b2 * w2
        at = GRADIENT + SCALE * BLOCK + j
        s[at] += d0 if seen & (raw0 > low) & (raw0 < high) else _F0
        s[at + BLOCK] += d1 if seen & (raw1 > low) & (raw1 < high) else _F0
        s[at + 2 * BLOCK] += d2 if seen & (raw2 > low) & (raw2 < high) else _F0
        a0, a1, a2, b0, b1, b2 = a0 * s0, a1 * s1, a2 * s2, b0 * s0, b1 * s1, b2 * s2
        # rotation: T^T dU, then the quaternion and its normalization
        d0, d1, d2 = t0 * a0 + t3 * b0, t0 * a1 + t3 * b1, t0 * a2 + t3 * b2
        d3, d4, d5 = t1 * a0 + t4 * b0, t1 * a1 + t4 * b1, t1 * a2 + t4 * b2
        d6, d7, d8 = t2 * a0 + t5 * b0, t2 * a1 + t5 * b1, t2 * a2 + t5 * b2
        nw = _F2 * (qx * (d7 - d5) + qy * (d2 - d6) + qz * (d3 - d1))
        nx = _F2 * (qy * (d1 + d3) + qz * (d2 + d6) + qw * (d7 - d5) - _F2 * qx * (d4 + d8))
        ny = _F2 * (qx * (d1 + d3) + qz * (d5 + d7) + qw * (d2 - d6) - _F2 * qy * (d0 + d8))
        nz = _F2 * (qx * (d2 + d6) + qy * (d5 + d7) + qw * (d3 - d1) - _F2 * qz * (d0 + d4))
        along = nw * qw + nx * qx + ny * qy + nz * qz
        at = GRADIENT + QUATERNION * BLOCK + j
        directed = seen & (q_inverse > _F0)
        s[at] += (nw - along * qw) * q_inverse if directed else _F0
        s[at + BLOCK] += (nx - along * qx) * q_inverse if directed else _F0
        s[at + 2 * BLOCK] += (ny - along * qy) * q_inverse if directed else _F0
        s[at + 3 * BLOCK] += (nz - along * qz) * q_inverse if directed else _F0
        # dT = dU R^T, then dJ = dT W^T
        c0, c1, c2 = a0 * r0 + a1 * r1 + a2 * r2, a0 * r3 + a1 * r4 + a2 * r5, a0 * r6 + a1 * r7 + a2 * r8
        c3, c4, c5 = b0 * r0 + b1 * r1 + b2 * r2, b0 * r3 + b1 * r4 + b2 * r5, b0 * r6 + b1 * r7 + b2 * r8
        k0, k1, k2 = rotate_to_camera(cam, c0, c1, c2)
        k3, k4, k5 = rotate_to_camera(cam, c3, c4, c5)
        dz = -inverse * (k0 * j0 + k1 * j1 + k2 * j2 + k3 * j3 + k4 * j4 + k5 * j5)
        # derivatives of J by the ratios: J = D P with P = (1, 0, -ta; 0, 1, -tc) / z
        dda = fx * du * dxx + fy * dv * dxy
        ddc = fx * du * dxy + fy * dv * dyy
        p0, p1 = gx * (k0 - ta * k2), gx * (k1 - tc * k2)  # by dxx and dxy through the first row
        p2, p3 = gy * (k3 - ta * k5), gy * (k4 - tc * k5)  # by dxy and dyy through the second
        lens_a = p0 * xxx + (p1 + p2) * xxy + p3 * xyy - (gx * dxx * k2 + gy * dxy * k5)
        lens_c = p0 * xxy + (p1 + p2) * xyy + p3 * yyy - (gx * dxy * k2 + gy * dyy * k5)
        dda += lens_a if a == ta else _F0
        ddc += lens_c if c == tc else _F0
        dx, dy = dda * inverse, ddc * inverse
        dz -= (dda * a + ddc * c) * inverse
        o0 = cam[0] * dx + cam[3] * dy + cam[6] * dz
        o1 = cam[1] * dx + cam[4] * dy + cam[7] * dz
        o2 = cam[2] * dx + cam[5] * dy + cam[8] * dz
        at = GRADIENT + j
        s[at] += o0 if seen else _F0
        s[at + BLOCK] += o1 if seen else _F0
        s[at + 2 * BLOCK] += o2 if seen else _F0
        opaque = s[SUM + j] * (_F1 - s[_ALPHA + j])
        s[at + OPACITY * BLOCK] += opaque if seen & (abs(s[_RAW + j]) <= bounded) else _F0
        s[at + COLOR * BLOCK] += s[SUM + 6 * BLOCK + j]
        s[at + (COLOR + 1) * BLOCK] += s[SUM + 7 * BLOCK + j]
        s[at + (COLOR + 2) * BLOCK] += s[SUM + 8 * BLOCK + j]
        s[SLOPE + j] = np.sqrt(du * du + dv * dv) if seen else _F0


@device_function
def harmonics_backward(cam, params, base, count, s):
    """Add the gradient by way of the view-dependent color, which ``project_backward`` leaves out."""
    if params.shape[1] == BASE:
        return
    for j in range(count):
        if s[SEEN + j] == _F0:
            continue
        i, at = base + j, GRADIENT + j
        nx, ny, nz = params[i, 0] - cam[ORIGIN], params[i, 1] - cam[ORIGIN + 1], (params[i, 2] - cam[ORIGIN + 2])
        length = _F1 / max(np.sqrt(nx * nx + ny * ny + nz * nz), np.float32(1e-9))
        nx, ny, nz = nx * length, ny * length, nz * length
        lx, ly, lz = _F0, _F0, _F0
        for h in range(1, 4):
            value = harmonic(h, nx, ny, nz)
            share = _F0
            for k in range(3):
                column, given = BASE + 3 * (h - 1) + k, s[SUM + (6 + k) * BLOCK + j]
                s[at + column * BLOCK] += value * given
                share += params[i, column] * given
            share *= np.float32(SH_C1)  # each harmonic has a slope by its own axis alone
            if h == 1:
                ly += share
            elif h == 2:
                lz += share
            else:
                lx += share
        along = lx * nx + ly * ny + lz * nz
        s[at] += (lx - along * nx) * length
        s[at + BLOCK] += (ly - along * ny) * length
        s[at + 2 * BLOCK] += (lz - along * nz) * length


@device_function
def add_torque(cam, s, count, total):
    """Add to ``total``, float64 (3,), the torque on the block's first ``count`` Gaussians as parts of one rigid body,
    about the camera's center: the gradient by a rotation vector, world axes, that would turn all of them. Before
    ``harmonics_backward``: colors seen from the camera stay as they are when it turns."""
    t0 = t1 = t2 = _F0
    for j in range(count):
        at = GRADIENT + j
        x, y, z = s[_X + j] - cam[ORIGIN], s[_X + BLOCK + j] - cam[ORIGIN + 1], s[_X + 2 * BLOCK + j] - cam[ORIGIN + 2]
        fx, fy, fz = s[at], s[at + BLOCK], s[at + 2 * BLOCK]
        qw, qx, qy, qz = s[_Q + j], s[_Q + BLOCK + j], s[_Q + 2 * BLOCK + j], s[_Q + 3 * BLOCK + j]
        gw, gx = s[at + QUATERNION * BLOCK], s[at + (QUATERNION + 1) * BLOCK]
        gy, gz = s[at + (QUATERNION + 2) * BLOCK], s[at + (QUATERNION + 3) * BLOCK]
        # A small rotation w multiplies the quaternion by (1, w / 2) from the left.
        t0 += y * fz - z * fy + _HALF * (qw * gx - gw * qx + qy * gz - qz * gy)
        t1 += z * fx - x * fz + _HALF * (qw * gy - gw * qy + qz * gx - qx * gz)
        t2 += x * fy - y * fx + _HALF * (qw * gz - gw * qz + qx * gy - qy * gx)
    total[0], total[1], total[2] = total[0] + t0, total[1] + t1, total[2] + t2


@device_function
def add_force(s, count, total):
    """Add to ``total``, float64 (3,), the force on the block's first ``count`` Gaussians: the gradient by a shift of
    all of them. After ``harmonics_backward``."""
    f0 = f1 = f2 = _F0
    for j in range(count):
        f0, f1, f2 = f0 + s[GRADIENT + j], f1 + s[GRADIENT + BLOCK + j], f2 + s[GRADIENT + 2 * BLOCK + j]
    total[0], total[1], total[2] = total[0] + f0, total[1] + f1, total[2] + f2
