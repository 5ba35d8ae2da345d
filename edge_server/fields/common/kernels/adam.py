"""Sparse Adam (Kingma and Ba 2015): updates only what received a gradient, drops what is not finite."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from edge_server.fields.common.kernels.hash_grid import SEGMENT
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add, is_finite
from edge_server.fields.field_constants import GRADIENT_LIMIT, PARAMETER_LIMIT

PART = 512  # segments a task

_F0, _F1 = np.float32(0.0), np.float32(1.0)


class Rule(NamedTuple):
    """One step's hyperparameters, float32. scale: factor on gradients. correct1, correct2: the bias
    corrections 1 / (1 - beta^t)."""

    rate: np.float32
    beta1: np.float32
    beta2: np.float32
    epsilon: np.float32
    scale: np.float32
    correct1: np.float32
    correct2: np.float32


@device_function
def _update(rule, p, g, m, v):
    """One step on equal-length float32 arrays; clears g. Returns how many gradients were not finite.

    Entries without gradient keep their moments. Parameters that are not finite become 0.
    """
    dropped = 0
    limit, bound = np.float32(GRADIENT_LIMIT), np.float32(PARAMETER_LIMIT)
    for k in range(p.size):
        raw = g[k] * rule.scale
        g[k] = _F0
        finite = is_finite(raw)
        dropped += 0 if finite else 1
        use = finite and raw != _F0
        d = min(max(raw, -limit), limit)
        m0, v0 = m[k] if is_finite(m[k]) else _F0, v[k] if is_finite(v[k]) else _F0
        m1 = rule.beta1 * m0 + (_F1 - rule.beta1) * d
        v1 = rule.beta2 * v0 + (_F1 - rule.beta2) * d * d
        root = np.sqrt(v1 * rule.correct2) + rule.epsilon
        q = p[k] - rule.rate * (m1 * rule.correct1 / root)
        m[k] = m1 if use else m0
        v[k] = v1 if use else v0
        q = q if use else p[k]
        q = min(max(q, -bound), bound)
        p[k] = q if is_finite(p[k]) else _F0
    return dropped


@kernel
def adam(counter, worker, net, table, d_params, rule_net, rule_table, dropped):
    """One optimizer step.

    net: tuple of float32 (P,) arrays (params, m, v, g). d_params: float32 (chunks, P), summed here in the
    order of the chunks. table: (params, m, v, g) float32 (vertices, 2) and dirty, bool
    (vertices / SEGMENT,), cleared. dropped: int64 (tasks,), receives the counts; task 0 is the net.
    """
    p, m, v, g, dirty = table
    flat_p, flat_m, flat_v, flat_g = p.reshape(-1), m.reshape(-1), v.reshape(-1), g.reshape(-1)
    width = SEGMENT * 2
    tasks = 1 + (dirty.size + PART - 1) // PART
    while True:
        task = fetch_add(counter, 1)
        if task >= tasks:
            return
        if task == 0:
            total = net[3]
            total[:] = _F0
            for c in range(d_params.shape[0]):
                for k in range(total.size):
                    total[k] += d_params[c, k]
            dropped[0] = _update(rule_net, net[0], total, net[1], net[2])
            continue
        count = 0
        for segment in range((task - 1) * PART, min(task * PART, dirty.size)):
            if dirty[segment]:
                dirty[segment] = False
                a, b = segment * width, (segment + 1) * width
                count += _update(rule_table, flat_p[a:b], flat_g[a:b], flat_m[a:b], flat_v[a:b])
        dropped[task] = count
