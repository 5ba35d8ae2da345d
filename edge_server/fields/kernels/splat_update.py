"""One optimiser step of the Gaussians: their pairs' gradients gathered in a fixed order, then Adam."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.kernels.intrinsics import fetch_add, is_finite
from edge_server.fields.kernels.jit import kernel, part
from edge_server.fields.kernels.splat_project import (
    BASE,
    BLOCK,
    COLOR,
    OPACITY,
    POSITION,
    QUATERNION,
    RADIUS,
    SCALE,
    SIZE,
    project_back,
)
from edge_server.fields.kernels.splat_raster import SUMS

GRADIENT_LIMIT = 1e6
OPACITY_LIMIT = 9.0  # raw: 1.2e-4 to .99988
COLOR_LOW, COLOR_HIGH = -0.5, 1.5  # a Gaussian's own colour may leave [0, 1] a little: pictures are clamped
POSITION_LIMIT = 100.0  # scene units
DEAD = -9.0  # raw opacity of a Gaussian that was not finite: it is not seen, and soon pruned

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class Moments(NamedTuple):
    """Adam's, and what densification goes by; N Gaussians, P parameters.

    m, v: float32 (N, P). age: int32 (N,), steps each has made. slope: float32 (N,), sum of the picture
    gradients' lengths; looks: float32 (N,), how many; reach: float32 (N,), the largest standard deviation in
    a picture as a share of its width."""

    m: NDArray[np.float32]
    v: NDArray[np.float32]
    age: NDArray[np.int32]
    slope: NDArray[np.float32]
    looks: NDArray[np.float32]
    reach: NDArray[np.float32]


class Rule(NamedTuple):
    """One step's rule. rates: float32 (P,). corrections: float32 (A, 3) by age, the last row for all higher
    ones: Adam's two 1 / (1 - beta^t), and the share of the rates that is left. fade: pull on opacity, in loss
    per unit of opacity. largest: scale limit in scene units; thinnest: logarithm of the largest aspect."""

    rates: NDArray[np.float32]
    corrections: NDArray[np.float32]
    beta1: np.float32
    beta2: np.float32
    epsilon: np.float32
    fade: np.float32
    largest: np.float32
    thinnest: np.float32


@part
def bound(params, i, largest, thinnest):
    """Hold Gaussian i to what it may be: finite, not a needle, not a giant."""
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
    top = np.log(largest * far)
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
def bound_all(params, largest, thinnest):
    """``bound`` for every Gaussian."""
    for i in range(params.shape[0]):
        bound(params, i, largest, thinnest)


@kernel
def update(counter, worker, cams, gaussians, count, projected, own_first, own_count, pair_sums, moments, rule,
           dropped):  # fmt: skip
    """Tasks are blocks of Gaussians. dropped: int64 (blocks,), written: gradients that were not finite.

    A Gaussian that no pair of this step belongs to stays as it is, its moments too.
    """
    params = gaussians.params
    width = params.shape[1]
    g, sums = np.empty(width, np.float32), np.empty(SUMS, np.float32)
    blocks = (count + BLOCK - 1) // BLOCK
    while True:
        block = fetch_add(counter, 1)
        if block >= blocks:
            return
        lost = 0
        for i in range(block * BLOCK, min((block + 1) * BLOCK, count)):
            touched = False
            for b in range(cams.shape[0]):
                first, pairs = np.int64(own_first[b, i]), np.int64(own_count[b, i])
                if pairs == 0:
                    continue
                if not touched:
                    for k in range(width):
                        g[k] = _F0
                    touched = True
                for k in range(SUMS):
                    sums[k] = _F0
                for p in range(first, first + pairs):
                    for k in range(SUMS):
                        sums[k] += pair_sums[b, p, k]
                slope = project_back(
                    cams, b, params, gaussians.velocity, gaussians.harmonics, i, sums, projected, g
                )
                if is_finite(slope) and slope > _F0:
                    moments.slope[i] += slope * cams[b, SIZE]
                    moments.looks[i] += _F1
                moments.reach[i] = max(moments.reach[i], projected[b, i, RADIUS] / cams[b, SIZE])
            if not touched:
                continue
            if rule.fade > _F0:
                alpha = _F1 / (_F1 + np.exp(-params[i, OPACITY]))
                g[OPACITY] += rule.fade * alpha * (_F1 - alpha)
            moments.age[i] += 1
            age = min(np.int64(moments.age[i]), np.int64(rule.corrections.shape[0] - 1))
            correct1, correct2, calm = (
                rule.corrections[age, 0],
                rule.corrections[age, 1],
                rule.corrections[age, 2],
            )
            far = max(_F1, max(abs(params[i, 0]), max(abs(params[i, 1]), abs(params[i, 2]))))
            limit = np.float32(GRADIENT_LIMIT)
            for k in range(width):
                d = g[k]
                if not is_finite(d):
                    lost += 1
                    continue
                d = min(max(d, -limit), limit)
                m = rule.beta1 * moments.m[i, k] + (_F1 - rule.beta1) * d
                v = rule.beta2 * moments.v[i, k] + (_F1 - rule.beta2) * d * d
                if not (is_finite(m) and is_finite(v)):
                    m, v = _F0, _F0
                moments.m[i, k], moments.v[i, k] = m, v
                rate = rule.rates[k] * calm * (far if k < SCALE else _F1)
                params[i, k] -= rate * m * correct1 / (np.sqrt(v * correct2) + rule.epsilon)
            bound(params, i, rule.largest, rule.thinnest)
        dropped[block] = lost


@kernel
def pull(counter, worker, cams, gaussians, which, projected, own_first, own_count, pair_sums, slope):
    """The gradient by position alone of Gaussians ``which`` (int64 (M,)), to slope: float32 (M, 3)."""
    width = gaussians.params.shape[1]
    g, sums = np.empty(width, np.float32), np.empty(SUMS, np.float32)
    while True:
        base = fetch_add(counter, 1) * BLOCK
        if base >= which.size:
            return
        for n in range(base, min(base + BLOCK, which.size)):
            i = which[n]
            for k in range(width):
                g[k] = _F0
            for b in range(cams.shape[0]):
                first, pairs = np.int64(own_first[b, i]), np.int64(own_count[b, i])
                if pairs == 0:
                    continue
                for k in range(SUMS):
                    sums[k] = _F0
                for p in range(first, first + pairs):
                    for k in range(SUMS):
                        sums[k] += pair_sums[b, p, k]
                project_back(
                    cams, b, gaussians.params, gaussians.velocity, gaussians.harmonics, i, sums, projected, g
                )
            for k in range(3):
                slope[n, k] = g[k] if is_finite(g[k]) else _F0
