"""The optimizer step: each Gaussian gathers its pairs' gradients in a fixed order, then an Adam step."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import SIZE, load_camera
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import draw, is_finite, log32
from edge_server.fields.field_constants import BETA1, BETA2
from edge_server.fields.splat.kernels.project import BASE, BLOCK, COLOR, OPACITY, POSITION, QUATERNION, RADIUS, SCALE
from edge_server.fields.splat.kernels.project_backward import (
    GRADIENT,
    SEEN,
    SLOPE,
    add_force,
    add_torque,
    block_scratch,
    gather_sums,
    harmonics_backward,
    load_block,
    project_backward,
)
from edge_server.fields.splat.splat_constants import (
    ASPECT,
    COLOR_HIGH,
    COLOR_LOW,
    GRADIENT_LIMIT,
    LARGEST,
    LOG_SCALE_LEAST,
    POSITION_LIMIT,
    RATE_SETTLED,
    RAW_OPACITY_LIMIT,
    SETTLE_STEPS,
)

DEAD = -RAW_OPACITY_LIMIT  # raw opacity of a Gaussian that was not finite: invisible, and soon pruned
_AGES = 4096  # steps after which Adam's bias correction no longer matters

_F0, _F1, _NAN = np.float32(0.0), np.float32(1.0), np.float32(np.nan)
_BETA1, _BETA2 = np.float32(BETA1), np.float32(BETA2)
_LOG_ASPECT = np.float32(np.log(ASPECT))


class OptimizerState(NamedTuple):
    """Adam's moments and the statistics that densification uses; N Gaussians, P parameters.

    m, v: float32 (N, P), first and second moments.
    age: int32 (N,), steps that each Gaussian has made.
    slope: float32 (N,), sum of the lengths of the gradients by the projected mean.
    looks: float32 (N,), how many gradients that is.
    reach: float32 (N,), largest projected standard deviation, as a share of the image's width.
    """

    m: NDArray[np.float32]
    v: NDArray[np.float32]
    age: NDArray[np.int32]
    slope: NDArray[np.float32]
    looks: NDArray[np.float32]
    reach: NDArray[np.float32]


class AdamParameters(NamedTuple):
    """Parameters of one step.

    rates: float32 (P,), learning rates.
    corrections: float32 (A, 3) by age, the last row for all higher ages: Adam's two bias corrections
        1 / (1 - beta^t), and the share of the rates that is left.
    epsilon: Adam's.
    """

    rates: NDArray[np.float32]
    corrections: NDArray[np.float32]
    epsilon: np.float32


@cache
def age_corrections(settle_steps: float = SETTLE_STEPS) -> NDArray[np.float32]:
    """``AdamParameters.corrections``, (4096, 3), of Gaussians that train at full rates for ``settle_steps``."""
    age = np.maximum(np.arange(_AGES), 1)
    decay = np.maximum(np.minimum(settle_steps / age, 1.0), RATE_SETTLED)
    return np.stack([1.0 / (1.0 - BETA1**age), 1.0 / (1.0 - BETA2**age), decay], axis=-1).astype(np.float32)


@device_function
def clamp_gaussian(params, i):
    """Clamp Gaussian i to its bounds: finite, not a needle, not a giant."""
    row = params[i]
    total = _F0
    for k in range(row.size):
        total += row[k]
    if not is_finite(total):
        for k in range(row.size):
            row[k] = row[k] if is_finite(row[k]) else _F0
        row[OPACITY] = np.float32(DEAD)
    far = _F1
    for k in range(3):
        x = min(max(row[POSITION + k], np.float32(-POSITION_LIMIT)), np.float32(POSITION_LIMIT))
        row[POSITION + k] = x
        far = max(far, abs(x))
    top = log32(np.float32(LARGEST) * far)
    for k in range(3):
        row[SCALE + k] = min(row[SCALE + k], top)
    low = max(row[SCALE], max(row[SCALE + 1], row[SCALE + 2])) - _LOG_ASPECT
    for k in range(3):
        row[SCALE + k] = max(row[SCALE + k], max(low, np.float32(LOG_SCALE_LEAST)))
    square = _F0
    for k in range(4):
        square += row[QUATERNION + k] * row[QUATERNION + k]
    if not (square > np.float32(1e-6) and square < np.float32(1e6)):
        row[QUATERNION] = _F1
        row[QUATERNION + 1] = row[QUATERNION + 2] = row[QUATERNION + 3] = _F0
    row[OPACITY] = min(max(row[OPACITY], np.float32(-RAW_OPACITY_LIMIT)), np.float32(RAW_OPACITY_LIMIT))
    for k in range(COLOR, row.size):
        low_color = np.float32(COLOR_LOW) if k < BASE else np.float32(-1.0)
        high_color = np.float32(COLOR_HIGH) if k < BASE else _F1
        row[k] = min(max(row[k], low_color), high_color)


@kernel
def clamp_gaussians(params):
    """``clamp_gaussian`` for all: params, float32 (N, P)."""
    for i in range(params.shape[0]):
        clamp_gaussian(params, i)


@device_function
def _gather_gradients(base, here, params, moments, rule, s, g):
    """Write a block's gradients (NaN: leave the parameter as it is), rates and second bias corrections to the
    thirds of ``g``, a Gaussian's parameters side by side. Returns how many gradients are not finite."""
    width = params.shape[1]
    third, lost = BLOCK * width, 0
    for j in range(here):
        i, at = base + j, j * width
        if s[SEEN + j] == _F0:
            for k in range(width):
                g[at + k] = _NAN
            continue
        moments.age[i] += 1
        age = min(np.int64(moments.age[i]), np.int64(rule.corrections.shape[0] - 1))
        rate, second = rule.corrections[age, 0] * rule.corrections[age, 2], rule.corrections[age, 1]
        far = max(_F1, max(abs(params[i, 0]), max(abs(params[i, 1]), abs(params[i, 2]))))
        for k in range(width):
            d = s[GRADIENT + k * BLOCK + j]
            lost += np.int64(not is_finite(d))
            g[at + k], g[third + at + k], g[2 * third + at + k] = d, rate * rule.rates[k], second
        for k in range(POSITION, POSITION + 3):
            g[third + at + k] *= far
    return lost


@device_function
def _adam(first, size, params, moments, rule, g):
    """An Adam step for parameters first, ..., first + size - 1 of the flattened arrays; g: see
    ``_gather_gradients``. A block at once: the fourteen parameters of one Gaussian do not fill a register. Slices: an
    index that might be negative keeps the loop from being vectorized."""
    third, limit = g.size // 3, np.float32(GRADIENT_LIMIT)
    gradients, rates, seconds = g[:third], g[third : 2 * third], g[2 * third :]
    x = params.reshape(-1)[first : first + size]
    xm, xv = moments.m.reshape(-1)[first : first + size], moments.v.reshape(-1)[first : first + size]
    for k in range(size):
        old, old_m, old_v, given = x[k], xm[k], xv[k], gradients[k]
        d = min(max(given, -limit), limit)
        m = _BETA1 * old_m + (_F1 - _BETA1) * d
        v = _BETA2 * old_v + (_F1 - _BETA2) * d * d
        sound = is_finite(m) & is_finite(v)
        m, v = m if sound else _F0, v if sound else _F0
        moves = is_finite(given)
        step = rates[k] * m / (np.sqrt(v * seconds[k]) + rule.epsilon)
        x[k] = old - step if moves else old
        xm[k], xv[k] = m if moves else old_m, v if moves else old_v


@kernel
def adam_step(counter, worker, camera, params, count, projected, lists, pair_sums, moments, rule, dropped, rigid):
    """An Adam step of all Gaussians that have pairs; the others and their moments stay as they are. Tasks
    are blocks of Gaussians.

    camera: float32 (1, CAMERA), the camera of this step.
    projected, lists, pair_sums: see ``project``, ``TileLists``, ``composite_backward``.
    moments: ``OptimizerState``, updated. rule: ``AdamParameters``.
    dropped: int64 (blocks,), written: gradients that were not finite.
    rigid: float64 (blocks, 6), 0 at first; sums over blocks are the force and torque on all Gaussians as one rigid
        body, about the camera's center (``add_force``, ``add_torque``). (0, 6): not asked for.
    """
    width = params.shape[1]
    s, g = block_scratch(width), np.empty(3 * width * BLOCK, np.float32)
    blocks = (count + BLOCK - 1) // BLOCK
    while True:
        block = draw(counter, worker, blocks)
        if block >= blocks:
            return
        base = block * BLOCK
        here = min(BLOCK, count - base)
        dropped[block] = 0
        if gather_sums(base, here, projected, lists, pair_sums, s) == 0:
            continue
        load_block(params, base, here, s)
        cam = load_camera(camera, 0)
        project_backward(cam, s)
        if rigid.shape[0] > 0:
            add_torque(cam, s, here, rigid[block, 3:])
        harmonics_backward(cam, params, base, here, s)
        if rigid.shape[0] > 0:
            add_force(s, here, rigid[block])
        for j in range(here):
            i, slope = base + j, s[SLOPE + j]
            if s[SEEN + j] == _F0:
                continue
            if is_finite(slope) and slope > _F0:
                moments.slope[i] += slope * cam[SIZE]
                moments.looks[i] += _F1
            moments.reach[i] = max(moments.reach[i], projected[i, RADIUS] / cam[SIZE])
        dropped[block] = _gather_gradients(base, here, params, moments, rule, s, g)
        _adam(base * width, here * width, params, moments, rule, g)
        for j in range(here):
            if s[SEEN + j] > _F0:
                clamp_gaussian(params, base + j)
