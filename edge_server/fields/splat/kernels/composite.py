"""Alpha compositing (thesis 3.20 with alphas in place of densities) and its gradient, strip by strip.

A strip is two rows of a tile: 16 pixels, one vector register. Its transmittance and colors stay in registers
while its Gaussians are composited. A Gaussian of a tile's list reaches half of the strips on average; the
others skip it. "Light" is transmittance: the share of light that still passes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.common.kernels.simd_vectors import (
    LANES,
    Vector,
    any_lane,
    constant,
    eight_lane_sums,
    lane_sum,
    require_contiguous,
)
from edge_server.fields.splat.kernels.project import (
    ALPHA,
    CONIC_A,
    CONIC_B,
    CONIC_C,
    DEPTH,
    HALF_HEIGHT,
    MEAN_X,
    MEAN_Y,
    PROJECTED,
    RED,
    TILE,
)
from edge_server.fields.splat.splat_constants import ALPHA_MAX, ALPHA_MIN, STOP

SUMS = 9  # sums that the backward pass gathers a pair: see ``project_backward``

STRIPS = 4
STRIP = LANES  # pixels
PIXELS = TILE * TILE
SAVED = 2 * STRIP  # floats a Gaussian and strip that the forward pass saves: alphas, and light before them

_I64 = ir.IntType(64)
_TO_2 = -0.5 / np.log(2.0)  # exp(-form / 2) = 2^(form * _TO_2)
_F0, _HALF = np.float32(0.0), np.float32(0.5)
_LAST, _SLACK = np.float32(TILE - 1), np.float32(1e-3)  # pixels


@device_function
def bin_strips(lists, begin, end, projected, y0, strip_pairs, count):
    """Split a tile's list lists.pair[begin:end] into one list a strip, front to back. y0: the tile's
    first row of pixels. strip_pairs: int32 (STRIPS, N) and count: int64 (STRIPS,), both written."""
    n0 = n1 = n2 = n3 = 0
    for j in range(begin, end):
        p = lists.pair[j]
        i = lists.owner[p]
        middle = projected[i, MEAN_Y] - np.float32(y0) - _HALF
        reach = projected[i, HALF_HEIGHT] + _SLACK
        # Clamped to rows 0..7: the list has only Gaussians that reach the tile.
        top = np.int64(min(max(np.ceil(middle - reach), _F0), _LAST)) >> 1
        bottom = np.int64(min(max(middle + reach, _F0), _LAST)) >> 1
        # Written unconditionally: a branch here would be mispredicted too often.
        strip_pairs[0, n0], strip_pairs[1, n1], strip_pairs[2, n2], strip_pairs[3, n3] = p, p, p, p
        n0 += np.int64(top == 0)
        n1 += np.int64((top <= 1) & (bottom >= 1))
        n2 += np.int64((top <= 2) & (bottom >= 2))
        n3 += np.int64(bottom == 3)
    count[0], count[1], count[2], count[3] = n0, n1, n2, n3


class _StripBuilder:
    """Emits the code that both passes share: pointers into arrays, and a strip's pixels."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.context, self.builder = context, builder
        self.kinds, self.args = signature.args, args

    def data(self, n: int) -> Any:
        """The data pointer of array argument n."""
        return self.context.make_array(self.kinds[n])(self.context, self.builder, self.args[n]).data

    def at(self, data: Any, *numbers: Any) -> Any:
        """A pointer to the element at the sum of ``numbers``."""
        place = self.builder.gep(data, [numbers[0]])
        for n in numbers[1:]:
            place = self.builder.gep(place, [n if not isinstance(n, int) else _I64(n)])
        return place

    def variables(self, vectors: list[Vector]) -> list[Any]:
        """Loop-carried variables, which LLVM keeps in registers."""
        found = [cgutils.alloca_once(self.builder, w.value.type) for w in vectors]
        self.set(found, vectors)
        return found

    def get(self, variables: list[Any]) -> list[Vector]:
        return [Vector(self.builder, self.builder.load(v)) for v in variables]

    def set(self, variables: list[Any], vectors: list[Vector]) -> None:
        for variable, vector in zip(variables, vectors, strict=True):
            self.builder.store(vector.value, variable)

    def pixels(self, x0: Any, y0: Any) -> tuple[Vector, Vector]:
        """Their centers, x and y."""
        across = Vector(self.builder, constant(*(k % TILE + 0.5 for k in range(STRIP))))
        down = Vector(self.builder, constant(*(k // TILE + 0.5 for k in range(STRIP))))
        return across + Vector.broadcast(self.builder, x0), down + Vector.broadcast(self.builder, y0)

    def number(self, data: Any, n: Any) -> Any:
        """Element n of int32 ``data``, as int64."""
        return self.builder.sext(self.builder.load(self.at(data, n)), _I64)

    def row(self, rows: Any, owners: Any, pair: Any) -> Any:
        """A pointer to the projected Gaussian of a pair."""
        return self.at(rows, self.builder.mul(self.number(owners, pair), _I64(PROJECTED)))

    def columns(self, row: Any, *which: int) -> list[Vector]:
        """Columns of a projected Gaussian, each broadcast to all lanes."""
        return [Vector.broadcast(self.builder, self.builder.load(self.at(row, _I64(k)))) for k in which]


@intrinsic
def composite(
    typingctx: Any,
    pairs: Any,
    count: Any,
    owner: Any,
    projected: Any,
    x0: Any,
    y0: Any,
    tile: Any,
    first: Any,
    saved: Any,
    step: Any,
) -> Any:
    """Composite a strip's Gaussians front to back. Returns how many were composited before ``STOP``.

    pairs: int32, pair numbers, of which the first ``count`` are used.
    owner: int32, the Gaussian of each pair.
    projected: float32 (N, PROJECTED).
    x0, y0: float32, corner of the strip's first pixel.
    tile: float32 rows of PIXELS: light, red, green, blue, depth; read and written.
    first: the strip's first column in these rows.
    saved: float32, written: at step * n the alphas of the n-th Gaussian and the light before it (SAVED).
    """
    require_contiguous(pairs, owner, projected, tile, saved)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        strip = _StripBuilder(context, builder, signature, args)
        pair_data, owners, rows, tile_data, saved_data = (strip.data(n) for n in (0, 2, 3, 6, 8))
        _, count, _, _, x0, y0, _, first, _, step = args
        x, y = strip.pixels(x0, y0)
        places = [strip.at(tile_data, first, PIXELS * k) for k in range(5)]
        state = strip.variables([Vector.load(builder, place) for place in places])
        composited = cgutils.alloca_once_value(builder, count)
        with cgutils.for_range(builder, count) as loop:
            row = strip.row(rows, owners, strip.number(pair_data, loop.index))
            mx, my, qa, qb, qc, alpha = strip.columns(row, MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, ALPHA)
            light, *colors = strip.get(state)
            dx, dy = x - mx, y - my
            form = dx * (dx * qa + (dy + dy) * qb) + (dy * qc) * dy
            a = ((form * _TO_2).exp2() * alpha).minimum(ALPHA_MAX)
            a = a.where(builder.and_(a.greater_equal(ALPHA_MIN), light.greater_equal(STOP)))
            keep = strip.at(saved_data, builder.mul(loop.index, step))
            a.store(keep)
            light.store(strip.at(keep, _I64(STRIP)))
            weight = a * light
            light = light - weight
            shades = strip.columns(row, RED, RED + 1, RED + 2, DEPTH)
            strip.set(state, [light, *(c + weight * s for c, s in zip(colors, shades, strict=True))])
            with builder.if_then(builder.not_(any_lane(builder, light.greater_equal(STOP))), likely=False):
                builder.store(builder.add(loop.index, _I64(1)), composited)
                loop.do_break()
        for place, vector in zip(places, strip.get(state), strict=True):
            vector.store(place)
        return builder.load(composited)

    f32, i64 = types.float32, types.int64
    return i64(pairs, i64, owner, projected, f32, f32, tile, i64, saved, i64), codegen


@intrinsic
def composite_backward(
    typingctx: Any,
    pairs: Any,
    count: Any,
    owner: Any,
    projected: Any,
    x0: Any,
    y0: Any,
    slopes: Any,
    first: Any,
    saved: Any,
    sums: Any,
) -> Any:
    """The gradient of ``composite``, back to front; arguments as there.

    slopes: float32 rows of PIXELS: d loss / d red, green and blue, and the background's share of the pixel's
        color times these.
    sums: float32 (P, SUMS), added to: see ``project_backward``.
    """
    require_contiguous(pairs, owner, projected, slopes, saved, sums)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        strip = _StripBuilder(context, builder, signature, args)
        pair_data, owners, rows, slope_data, saved_data, sum_data = (strip.data(n) for n in (0, 2, 3, 6, 8, 9))
        _, count, _, _, x0, y0, _, first, _, _ = args
        x, y = strip.pixels(x0, y0)
        er, eg, eb, behind = (Vector.load(builder, strip.at(slope_data, first, PIXELS * k)) for k in range(4))
        state = strip.variables([behind])
        with cgutils.for_range(builder, count) as loop:
            n = builder.sub(builder.sub(count, _I64(1)), loop.index)
            pair = strip.number(pair_data, n)
            row = strip.row(rows, owners, pair)
            mx, my, red, green, blue = strip.columns(row, MEAN_X, MEAN_Y, RED, RED + 1, RED + 2)
            keep = strip.at(saved_data, builder.mul(n, _I64(SAVED)))
            a, light = Vector.load(builder, keep), Vector.load(builder, strip.at(keep, _I64(STRIP)))
            (behind,) = strip.get(state)
            dx, dy = x - mx, y - my
            weight, shade = a * light, er * red + eg * green + eb * blue
            h = (a * (light * shade - behind / a.one_minus())).where(a.less(ALPHA_MAX))
            strip.set(state, [behind + weight * shade])
            hx, hy = h * dx, h * dy
            total = strip.at(sum_data, builder.mul(pair, _I64(SUMS)))
            eight = eight_lane_sums([h, hx, hy, hx * dx, hx * dy, hy * dy, weight * er, weight * eg])
            place = builder.bitcast(total, eight.type.as_pointer())
            old = builder.load(place)
            old.align = 4
            builder.store(builder.fadd(old, eight), place).align = 4
            last = strip.at(total, _I64(SUMS - 1))
            builder.store(builder.fadd(builder.load(last), lane_sum(weight * eb)), last)
        return context.get_dummy_value()

    f32, i64 = types.float32, types.int64
    return types.void(pairs, i64, owner, projected, f32, f32, slopes, i64, saved, sums), codegen
