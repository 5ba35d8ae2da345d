"""Volume rendering along rays (thesis 3.20-3.22), its gradient, and regularizers of a ray's weights.

Transmittance is the exponential of an exclusive cumulative sum of optical depths: its gradient is right
where a sample is opaque, which that of a cumulative product is not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.common.kernels.simd import exp32, is_finite
from edge_server.fields.field_constants import GUIDE_REACH, OPAQUE_DEPTH

# Raw density is clamped before the exponential, forward and backward alike: the largest density makes one
# step opaque many times over, the smallest makes a whole ray transparent.
RAW_LOW, RAW_HIGH = -12.0, 9.0
SH_C1 = 0.4886025  # sqrt(3 / 4 pi), of spherical harmonics of degree 1

_F0, _F1 = np.float32(0.0), np.float32(1.0)

# A density beyond these was clamped, whatever the exponential's last bit, so it has no gradient.
_CLAMPED_LOW = np.float32(np.exp(RAW_LOW) * 1.00001)
_CLAMPED_HIGH = np.float32(np.exp(RAW_HIGH) * 0.99999)


class Weights(NamedTuple):
    """Strengths of the regularizers, float32.

    distortion: mip-NeRF 360's loss, gathers a ray's weight in one place.
    guide: penalty on weight away from a ray's guide and on light that passes through (Geman and McClure's
        robust estimator, so that a wrong guide pulls no harder than a doubtful one).
    """

    distortion: np.float32
    guide: np.float32 = np.float32(0.0)


@device_function
def harmonic(k, x, y, z):
    """Real spherical harmonics of degree 1, k = 1, 2, 3, of a unit direction, float32; that of degree 0 is the color
    itself."""
    return np.float32(SH_C1) * (y if k == 1 else (z if k == 2 else x))


@device_function
def activate(out, a, b):
    """``activate_density`` and ``activate_color``."""
    activate_density(out, a, b)
    activate_color(out, a, b)


@device_function
def activate_density(out, a, b):
    """Raw density -> density, in place, samples a to b of row 0."""
    sigma = out[0, a:b]
    for s in range(sigma.size):
        sigma[s] = exp32(min(max(sigma[s], np.float32(RAW_LOW)), np.float32(RAW_HIGH)))


@device_function
def activate_color(out, a, b):
    """Raw colors -> colors in [0, 1], in place, samples a to b of rows 1 to 3."""
    for c in range(1, 4):
        row = out[c, a:b]
        for s in range(row.size):
            row[s] = _F1 / (_F1 + exp32(-row[s]))


@device_function
def samples_until_opaque(out, dts, first, end):
    """How many samples of a ray there are until it is opaque. Density is in row 0 of out."""
    depth = _F0
    for s in range(first, end):
        depth += out[0, s] * dts[s]
        if depth > np.float32(OPAQUE_DEPTH):
            return s + 1 - first
    return end - first


@device_function
def add_harmonics(out, sh_degree, first, end, dx, dy, dz):
    """Add the harmonics of direction (dx, dy, dz) to the raw colors, rows 1 to 3 of out, of samples first to
    end."""
    for k in range(1, 1 + 3 * sh_degree):
        y = harmonic(k, dx, dy, dz)
        for c in range(3):
            base, share = out[1 + c, first:end], out[1 + 3 * k + c, first:end]
            for s in range(base.size):
                base[s] += y * share[s]


@device_function
def add_harmonics_backward(d_out, sh_degree, first, end, dx, dy, dz):
    """The gradient of ``add_harmonics``: rows 4 on from rows 1 to 3 of d_out."""
    for k in range(1, 1 + 3 * sh_degree):
        y = harmonic(k, dx, dy, dz)
        for c in range(3):
            base, share = d_out[1 + c, first:end], d_out[1 + 3 * k + c, first:end]
            for s in range(base.size):
                share[s] = y * base[s]


@device_function
def ray_loss(out, d_out, ts, dts, w, first, end, target, background, guide, weights):
    """Squared color error of one ray (3.22) and its gradient.

    out: float32 (>= 4, N), activated density and color of samples first to end.
    d_out: like out, rows 0 to 3 receive dLoss / draw. ts, dts: float32 (N,), distance and length.
    w: float32 (N,), receives weights. target, background: float32 (3,).
    guide: float32, distance at which the ray probably ends; 0: unknown.
    Returns the color error, or -1 for a ray that is not finite: its gradient is 0.
    """
    depth, shade_r, shade_g, shade_b = _F0, _F0, _F0, _F0
    transmitted, weight, moment = _F1, _F0, _F0
    last = end
    for s in range(first, end):
        depth += out[0, s] * dts[s]
        after = exp32(-depth)
        w[s] = transmitted - after
        shade_r += w[s] * out[1, s]
        shade_g += w[s] * out[2, s]
        shade_b += w[s] * out[3, s]
        weight += w[s]
        moment += w[s] * ts[s]
        transmitted = after
        if depth > np.float32(OPAQUE_DEPTH):
            last = s + 1
            break
    e_r = shade_r + transmitted * background[0] - target[0]
    e_g = shade_g + transmitted * background[1] - target[1]
    e_b = shade_b + transmitted * background[2] - target[2]
    loss = e_r * e_r + e_g * e_g + e_b * e_b
    if not is_finite(loss):
        d_out[:4, first:end] = _F0
        return np.float32(-1.0)
    d_out[:4, last:end] = _F0
    two = np.float32(2.0)
    d_r, d_g, d_b = two * e_r, two * e_g, two * e_b
    behind = transmitted * (d_r * background[0] + d_g * background[1] + d_b * background[2])
    guided = weights.guide if guide > _F0 else _F0
    across = _F1 / (np.float32(GUIDE_REACH) * guide) if guide > _F0 else _F0
    behind += transmitted * guided
    weight_before, moment_before = weight, moment
    after = transmitted
    for s in range(last - 1, first - 1, -1):
        r, g, b, t, delta = out[1, s], out[2, s], out[3, s], ts[s], dts[s]
        weight_before -= w[s]
        moment_before -= w[s] * t
        weight_after = weight - weight_before - w[s]
        moment_after = moment - moment_before - w[s] * t
        spread = t * (weight_before - weight_after) - moment_before + moment_after
        d_w = d_r * r + d_g * g + d_b * b
        d_w += weights.distortion * (two * spread + np.float32(2.0 / 3.0) * w[s] * delta)
        if guided > _F0:
            off = (t - guide) * across
            d_w += guided * off * off / (_F1 + off * off)
        d_depth = d_w * after - behind
        behind += w[s] * d_w
        after += w[s]
        sigma = out[0, s]
        free = sigma > _CLAMPED_LOW and sigma < _CLAMPED_HIGH
        d_out[0, s] = d_depth * delta * sigma if free else _F0
        d_out[1, s] = w[s] * d_r * r * (_F1 - r)
        d_out[2, s] = w[s] * d_g * g * (_F1 - g)
        d_out[3, s] = w[s] * d_b * b * (_F1 - b)
    return loss
