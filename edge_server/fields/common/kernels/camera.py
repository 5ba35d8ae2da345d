"""A camera as a row of float32 that kernels read (``common.camera_rows``), its lens, and which points it sees."""

from __future__ import annotations

import numpy as np
from numba.np.unsafe.ndarray import to_fixed_tuple

from edge_server.fields.common.kernels.jit import device_function

# Columns: the rotation's nine numbers first. LENS: fx, fy, cx, cy, k1, k2, p1, p2. LIMITS: lowest and highest
# x / z, then y / z. SIZE: width, height.
ORIGIN, LENS, LIMITS, NEAR, SIZE, CAMERA = 9, 12, 20, 24, 25, 27

_F1, _F2 = np.float32(1.0), np.float32(2.0)


@device_function
def load_camera(cams, b):
    """Camera b's columns as a tuple of CAMERA numbers. From a tuple, a loop that writes to arrays need not
    read the camera again for every Gaussian, which would keep LLVM from vectorizing it."""
    return to_fixed_tuple(cams[b], CAMERA)


@device_function
def distort(cam, x, y):
    """Distorted normalized coordinates of (x, y), their Jacobian (symmetric: distortion is a gradient) and
    its derivatives xxx, xxy, xyy, yyy. cam: see ``load_camera``."""
    k1, k2, p1, p2 = cam[LENS + 4], cam[LENS + 5], cam[LENS + 6], cam[LENS + 7]
    six, eight = np.float32(6.0), np.float32(8.0)
    r2 = x * x + y * y
    radial = _F1 + r2 * (k1 + r2 * k2)
    g = k1 + _F2 * k2 * r2
    u = x * radial + _F2 * p1 * x * y + p2 * (r2 + _F2 * x * x)
    v = y * radial + p1 * (r2 + _F2 * y * y) + _F2 * p2 * x * y
    dxx = radial + _F2 * x * x * g + _F2 * p1 * y + six * p2 * x
    dxy = _F2 * x * y * g + _F2 * p1 * x + _F2 * p2 * y
    dyy = radial + _F2 * y * y * g + six * p1 * y + _F2 * p2 * x
    xxx = six * x * g + eight * k2 * x * x * x + six * p2
    xxy = _F2 * y * g + eight * k2 * x * x * y + _F2 * p1
    xyy = _F2 * x * g + eight * k2 * x * y * y + _F2 * p2
    yyy = six * y * g + eight * k2 * y * y * y + six * p1
    return u, v, dxx, dxy, dyy, xxx, xxy, xyy, yyy


@device_function
def rotate_to_camera(cam, x, y, z):
    """A vector in world axes -> in camera axes."""
    return (
        cam[0] * x + cam[1] * y + cam[2] * z,
        cam[3] * x + cam[4] * y + cam[5] * z,
        cam[6] * x + cam[7] * y + cam[8] * z,
    )


@device_function
def within_lens(cam, x, y):
    """Whether a direction (x, y, 1) is about within the field of view (LENS_FIELD times it): farther aside the lens's
    polynomial may fold back into the image."""
    return (x >= cam[LIMITS]) & (x <= cam[LIMITS + 1]) & (y >= cam[LIMITS + 2]) & (y <= cam[LIMITS + 3])


@device_function
def lens_terms(cam, x, y, z):
    """The projection of a camera point through the lens, and what the Jacobian J and its gradient need:
    x / z, y / z, both clamped, projected u, v, the lens's first and second derivatives, 1 / z. J is taken at
    the ratios clamped to LENS_FIELD times the field of view."""
    inverse = _F1 / z
    a, c = x * inverse, y * inverse
    ta = min(max(a, cam[LIMITS]), cam[LIMITS + 1])
    tc = min(max(c, cam[LIMITS + 2]), cam[LIMITS + 3])
    u, v, dxx, dxy, dyy, xxx, xxy, xyy, yyy = distort(cam, ta, tc)
    # Beyond the limits the lens is linear: its polynomial would fold back into the image out there.
    u += dxx * (a - ta) + dxy * (c - tc)
    v += dxy * (a - ta) + dyy * (c - tc)
    return a, c, ta, tc, u, v, dxx, dxy, dyy, xxx, xxy, xyy, yyy, inverse
