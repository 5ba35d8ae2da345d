"""A small multilayer perceptron over columns of samples: forward, backward, all widths multiples of 4.

Arrays are (units, samples), so that one unit's values lie side by side and every inner loop is a vector
loop. Blocks of BLOCK samples pass through all layers while their activations stay in the first-level cache.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.field_constants import FIRST_DENSITY, FIRST_OUTPUTS

BLOCK = 256
# Columns that rows of activations have beyond those that are used. Rows at a distance of a power of two would all lie
# in the same eight lines of the first-level cache: layers took half as long again.
PADDING = 16


class Net(NamedTuple):
    """widths: int64 (layers + 1,), multiples of 4. params: float32; per layer the matrix (out, in), row
    after row, then the bias (out,). ReLU after every layer but the last."""

    widths: NDArray[np.int64]
    params: NDArray[np.float32]


def init_net(inputs: int, outputs: int, hidden: list[int], rng: np.random.Generator) -> Net:
    """He initialization with a small output: thin gray fog everywhere. Widths are padded to 4: ``inputs`` features in;
    density, color, the color's harmonics and three numbers for each dimension of the appearance out."""
    widths = np.array([(inputs + 3) // 4 * 4, *hidden, (outputs + 3) // 4 * 4], dtype=np.int64)
    params, first = np.zeros(int(sum(o * i + o for i, o in pairwise(widths))), np.float32), 0
    for layer, (n_in, n_out) in enumerate(pairwise(widths)):
        last = layer == len(widths) - 2
        spread = np.sqrt(2.0 / n_in) * (FIRST_OUTPUTS if last else 1.0)
        params[first : first + n_in * n_out] = rng.normal(0.0, spread, int(n_in * n_out))
        if last:
            params[first + n_in * n_out] = np.log(FIRST_DENSITY)
        first += int(n_in * n_out + n_out)
    return Net(widths, params)


@device_function
def _combine(w, first, p, q, n_out, n_in, x, x_row, y, y_row, a, b):
    """y[y_row + o] += sum_i w[first + o p + i q] x[x_row + i], samples a to b: four outputs by four inputs at once."""
    for o in range(0, n_out, 4):
        y0, y1 = y[y_row + o, a:b], y[y_row + o + 1, a:b]
        y2, y3 = y[y_row + o + 2, a:b], y[y_row + o + 3, a:b]
        for i in range(0, n_in, 4):
            x0, x1 = x[x_row + i, a:b], x[x_row + i + 1, a:b]
            x2, x3 = x[x_row + i + 2, a:b], x[x_row + i + 3, a:b]
            at = first + o * p + i * q
            a0, a1, a2, a3 = w[at], w[at + q], w[at + 2 * q], w[at + 3 * q]
            at += p
            b0, b1, b2, b3 = w[at], w[at + q], w[at + 2 * q], w[at + 3 * q]
            at += p
            c0, c1, c2, c3 = w[at], w[at + q], w[at + 2 * q], w[at + 3 * q]
            at += p
            d0, d1, d2, d3 = w[at], w[at + q], w[at + 2 * q], w[at + 3 * q]
            for s in range(x0.size):
                r, u, v, z = x0[s], x1[s], x2[s], x3[s]
                y0[s] += a0 * r + a1 * u + a2 * v + a3 * z
                y1[s] += b0 * r + b1 * u + b2 * v + b3 * z
                y2[s] += c0 * r + c1 * u + c2 * v + c3 * z
                y3[s] += d0 * r + d1 * u + d2 * v + d3 * z


@device_function
def _weight_gradient(d_w, first, n_out, n_in, d_y, y_row, x, x_row, a, b):
    """d_w[o, i] += sum_s d_y[o, s] x[i, s], four by two dot products at a time."""
    zero = np.float32(0.0)
    for o in range(0, n_out, 4):
        y0, y1 = d_y[y_row + o, a:b], d_y[y_row + o + 1, a:b]
        y2, y3 = d_y[y_row + o + 2, a:b], d_y[y_row + o + 3, a:b]
        base = first + o * n_in
        for i in range(0, n_in, 2):
            x0, x1 = x[x_row + i, a:b], x[x_row + i + 1, a:b]
            a0 = a1 = b0 = b1 = c0 = c1 = d0 = d1 = zero
            for s in range(x0.size):
                u, v = x0[s], x1[s]
                a0 += y0[s] * u
                a1 += y0[s] * v
                b0 += y1[s] * u
                b1 += y1[s] * v
                c0 += y2[s] * u
                c1 += y2[s] * v
                d0 += y3[s] * u
                d1 += y3[s] * v
            d_w[base + i] += a0
            d_w[base + i + 1] += a1
            d_w[base + n_in + i] += b0
            d_w[base + n_in + i + 1] += b1
            d_w[base + 2 * n_in + i] += c0
            d_w[base + 2 * n_in + i + 1] += c1
            d_w[base + 3 * n_in + i] += d0
            d_w[base + 3 * n_in + i + 1] += d1


@device_function
def forward(net, acts, start, end):
    """Run samples start to end through the net.

    acts: float32 (sum of widths, N). Rows 0 .. widths[0] hold the input; each layer's output follows
    its input's rows, so the result stands in the last widths[-1] rows.
    """
    widths, params = net.widths, net.params
    zero = np.float32(0.0)
    for a in range(start, end, BLOCK):
        b = min(a + BLOCK, end)
        first, row = 0, 0
        for layer in range(widths.size - 1):
            n_in, n_out = widths[layer], widths[layer + 1]
            y_row = row + n_in
            for o in range(n_out):
                acts[y_row + o, a:b] = params[first + n_out * n_in + o]
            _combine(params, first, n_in, 1, n_out, n_in, acts, row, acts, y_row, a, b)
            if layer < widths.size - 2:
                for o in range(n_out):
                    h = acts[y_row + o, a:b]
                    for s in range(h.size):
                        h[s] = max(h[s], zero)
            first += n_out * n_in + n_out
            row = y_row


@device_function
def backward(net, acts, d_acts, n, d_params):
    """Gradients of n samples after ``forward``.

    d_acts: float32 like ``acts``; its last widths[-1] rows hold dLoss / doutput, the other rows are filled
    here, so that the first widths[0] rows end as dLoss / dinput. d_params: float32 like ``net.params``,
    added to.
    """
    widths, params = net.widths, net.params
    zero = np.float32(0.0)
    layers = widths.size - 1
    for a in range(0, n, BLOCK):
        b = min(a + BLOCK, n)
        first, row = params.size, acts.shape[0] - widths[layers]
        for layer in range(layers - 1, -1, -1):
            n_in, n_out = widths[layer], widths[layer + 1]
            first -= n_out * n_in + n_out
            x_row = row - n_in
            _weight_gradient(d_params, first, n_out, n_in, d_acts, row, acts, x_row, a, b)
            for o in range(n_out):
                total = zero
                d = d_acts[row + o, a:b]
                for s in range(d.size):
                    total += d[s]
                d_params[first + n_out * n_in + o] += total
            for i in range(n_in):
                d_acts[x_row + i, a:b] = zero
            _combine(params, first, 1, n_in, n_in, n_out, d_acts, row, d_acts, x_row, a, b)
            if layer > 0:
                for i in range(n_in):
                    h, d = acts[x_row + i, a:b], d_acts[x_row + i, a:b]
                    for s in range(h.size):
                        d[s] = d[s] if h[s] > zero else zero
            row = x_row
