"""The optimizer step: each Gaussian gathers its pairs' gradients in a fixed order, then an Adam step."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import SIZE, load_camera
from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.simd import draw, fetch_add, is_finite, log32
from edge_server.fields.splat.kernels.project import BASE, BLOCK, COLOR, OPACITY, POSITION, QUATERNION, RADIUS, SCALE
from edge_server.fields.splat.kernels.project_backward import (
    GRADIENT,
    SEEN,
    SLOPE,
    block_scratch,
    gather_sums,
    harmonics_backward,
    load_block,
    project_backward,
)
from edge_server.fields.splat.kernels.simd_vectors import LANES, Vector, mask_and, require_contiguous

GRADIENT_LIMIT = 1e6
OPACITY_LIMIT = 9.0  # raw: 1.2e-4 to .99988
COLOR_LOW, COLOR_HIGH = -0.5, 1.5  # a Gaussian's color may leave [0, 1] a little: rendered ones are clamped
POSITION_LIMIT = 100.0  # scene units
DEAD = -9.0  # raw opacity given to a Gaussian that was not finite: invisible, and soon pruned

_F0, _F1, _NAN = np.float32(0.0), np.float32(1.0), np.float32(np.nan)


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
    fade: penalty on opacity, loss per unit of opacity.
    largest: largest scale, scene units.
    thinnest: logarithm of the largest ratio of longest to shortest axis.
    """

    rates: NDArray[np.float32]
    corrections: NDArray[np.float32]
    beta1: np.float32
    beta2: np.float32
    epsilon: np.float32
    fade: np.float32
    largest: np.float32
    thinnest: np.float32


@part
def clamp_gaussian(params, i, largest, thinnest):
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
    top = log32(largest * far)
    for k in range(3):
        row[SCALE + k] = min(row[SCALE + k], top)
    low = max(row[SCALE], max(row[SCALE + 1], row[SCALE + 2])) - thinnest
    for k in range(3):
        row[SCALE + k] = max(row[SCALE + k], max(low, np.float32(-11.0)))
    square = _F0
    for k in range(4):
        square += row[QUATERNION + k] * row[QUATERNION + k]
    if not (square > np.float32(1e-6) and square < np.float32(1e6)):
        row[QUATERNION] = _F1
        row[QUATERNION + 1] = row[QUATERNION + 2] = row[QUATERNION + 3] = _F0
    row[OPACITY] = min(max(row[OPACITY], np.float32(-OPACITY_LIMIT)), np.float32(OPACITY_LIMIT))
    for k in range(COLOR, row.size):
        low_color = np.float32(COLOR_LOW) if k < BASE else np.float32(-1.0)
        high_color = np.float32(COLOR_HIGH) if k < BASE else _F1
        row[k] = min(max(row[k], low_color), high_color)


@kernel
def clamp_gaussians(params, largest, thinnest):
    """``clamp_gaussian`` for all: params, float32 (N, P). largest, thinnest: see ``AdamParameters``."""
    for i in range(params.shape[0]):
        clamp_gaussian(params, i, largest, thinnest)


@part
def _gather_gradients(base, here, touched, params, moments, rule, s, g):
    """Write a block's gradients (NaN: leave the parameter as it is), rates and second bias corrections to the
    thirds of ``g``, a Gaussian's parameters side by side. Returns how many gradients are not finite."""
    width = params.shape[1]
    third, lost = BLOCK * width, 0
    for j in range(here):
        i, at = base + j, j * width
        if not touched[j]:
            for k in range(width):
                g[at + k] = _NAN
            continue
        if rule.fade > _F0:
            alpha = _F1 / (_F1 + np.exp(-params[i, OPACITY]))
            s[GRADIENT + OPACITY * BLOCK + j] += rule.fade * alpha * (_F1 - alpha)
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


@intrinsic
def _adam_vectors(
    typingctx: Any,
    g: Any,
    third: Any,
    params: Any,
    m: Any,
    v: Any,
    first: Any,
    vectors: Any,
    beta1: Any,
    beta2: Any,
    epsilon: Any,
) -> Any:
    """``_adam`` for the first ``vectors`` * LANES of its parameters."""
    require_contiguous(g, params, m, v)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        g_data, params_data, m_data, v_data = (
            context.make_array(signature.args[k])(context, builder, args[k]).data for k in (0, 2, 3, 4)
        )
        _, third, _, _, _, first, vectors, *numbers = args
        i64 = ir.IntType(64)
        beta1, beta2, epsilon = (Vector.broadcast(builder, number) for number in numbers)
        with cgutils.for_range(builder, vectors) as loop:
            k = builder.mul(loop.index, i64(LANES))
            here = builder.add(first, k)
            places = [builder.gep(data, [here]) for data in (params_data, m_data, v_data)]
            old, old_m, old_v = (Vector.load(builder, place) for place in places)
            given, rate, second = (
                Vector.load(builder, builder.gep(builder.gep(g_data, [builder.mul(third, i64(n))]), [k]))
                for n in range(3)
            )
            d = given.maximum(-GRADIENT_LIMIT).minimum(GRADIENT_LIMIT)
            new_m = beta1 * old_m + beta1.one_minus() * d
            new_v = beta2 * old_v + beta2.one_minus() * d * d
            sound = mask_and(builder, new_m.is_finite(), new_v.is_finite())
            new_m, new_v = new_m.where(sound), new_v.where(sound)
            step = rate * new_m / ((new_v * second).sqrt() + epsilon)
            moves = given.is_finite()
            for place, new, before in zip(places, (old - step, new_m, new_v), (old, old_m, old_v), strict=True):
                new.where(moves, before).store(place)
        return context.get_dummy_value()

    f32, size = types.float32, types.int64
    return types.void(g, size, params, m, v, size, size, f32, f32, f32), codegen


@part
def _adam(first, size, params, moments, rule, g):
    """An Adam step for parameters first, ..., first + size - 1 of the flattened arrays; g: see
    ``_gather_gradients``. A block at once: the fourteen parameters of one Gaussian do not fill a register."""
    third, limit, width = g.size // 3, np.float32(GRADIENT_LIMIT), params.shape[1]
    vectors = size // LANES
    _adam_vectors(g, third, params, moments.m, moments.v, first, vectors, rule.beta1, rule.beta2, rule.epsilon)
    for k in range(vectors * LANES, size):  # the remainder, in the last block only
        i, column, d = (first + k) // width, (first + k) % width, g[k]
        if is_finite(d):
            d = min(max(d, -limit), limit)
            m = rule.beta1 * moments.m[i, column] + (_F1 - rule.beta1) * d
            v = rule.beta2 * moments.v[i, column] + (_F1 - rule.beta2) * d * d
            if not (is_finite(m) and is_finite(v)):
                m, v = _F0, _F0
            moments.m[i, column], moments.v[i, column] = m, v
            params[i, column] -= g[third + k] * m / (np.sqrt(v * g[2 * third + k]) + rule.epsilon)


@kernel
def adam_step(
    counter, worker, cams, gaussians, count, projected, own_first, own_count, pair_sums, moments, rule, dropped
):
    """An Adam step of all Gaussians that have pairs; the others and their moments stay as they are. Tasks
    are blocks of Gaussians.

    cams: float32 (B, CAMERA), the cameras of this step.
    projected, own_first, own_count, pair_sums: see ``project``, ``TileLists``, ``composite_backward``.
    moments: ``OptimizerState``, updated. rule: ``AdamParameters``.
    dropped: int64 (blocks,), written: gradients that were not finite.
    """
    params = gaussians.params
    width = params.shape[1]
    s, ids, touched = block_scratch(width), np.empty(BLOCK, np.int64), np.empty(BLOCK, np.bool_)
    g = np.empty(3 * width * BLOCK, np.float32)
    blocks = (count + BLOCK - 1) // BLOCK
    while True:
        block = draw(counter, worker, blocks)
        if block >= blocks:
            return
        base = block * BLOCK
        here = min(BLOCK, count - base)
        for j in range(here):
            ids[j], touched[j] = base + j, False
        load_block(gaussians, ids, here, s)
        for b in range(cams.shape[0]):
            if gather_sums(b, ids, here, projected, own_first, own_count, pair_sums, s) == 0:
                continue
            cam = load_camera(cams, b)
            project_backward(cam, s)
            harmonics_backward(cam, gaussians, ids, here, s)
            for j in range(here):
                i, slope = base + j, s[SLOPE + j]
                if s[SEEN + j] == _F0:
                    continue
                touched[j] = True
                if is_finite(slope) and slope > _F0:
                    moments.slope[i] += slope * cam[SIZE]
                    moments.looks[i] += _F1
                moments.reach[i] = max(moments.reach[i], projected[b, i, RADIUS] / cam[SIZE])
        lost = _gather_gradients(base, here, touched, params, moments, rule, s, g)
        _adam(base * width, here * width, params, moments, rule, g)
        for j in range(here):
            if touched[j]:
                clamp_gaussian(params, base + j, rule.largest, rule.thinnest)
        dropped[block] = lost


@kernel
def position_gradients(counter, worker, cams, gaussians, which, projected, own_first, own_count, pair_sums, slope):
    """Write the gradient by position of Gaussians ``which``, int64 (M,), to slope: float32 (M, 3)."""
    s, ids = block_scratch(gaussians.params.shape[1]), np.empty(BLOCK, np.int64)
    while True:
        base = fetch_add(counter, 1) * BLOCK
        if base >= which.size:
            return
        here = min(BLOCK, which.size - base)
        for j in range(here):
            ids[j] = which[base + j]
        load_block(gaussians, ids, here, s)
        for b in range(cams.shape[0]):
            if gather_sums(b, ids, here, projected, own_first, own_count, pair_sums, s) > 0:
                cam = load_camera(cams, b)
                project_backward(cam, s)
                harmonics_backward(cam, gaussians, ids, here, s)
        for j in range(here):
            for k in range(3):
                d = s[GRADIENT + k * BLOCK + j]
                slope[base + j, k] = d if is_finite(d) else _F0
