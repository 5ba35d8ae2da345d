"""A tile's Gaussians, front to back (thesis 3.20 with alphas in place of densities) and back, strip by strip.

A strip is two rows of a tile, 16 pixels: a register. Its light and colours stay in registers while all its
Gaussians pass; a Gaussian that is on a tile's list reaches half of its strips, and only those see it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from edge_server.fields.common.kernels.jit import part
from edge_server.fields.splat.kernels.project import (
    ALPHA,
    ALPHA_LEAST,
    DEPTH,
    HALF_HEIGHT,
    MX,
    MY,
    PROJECTED,
    QA,
    QB,
    QC,
    RED,
    TILE,
)
from edge_server.fields.splat.kernels.simd_vectors import (
    LANES,
    Wide,
    anywhere,
    both,
    constant,
    contiguous,
    eight_sums,
    sum_of,
)

# One constant in both passes: no Gaussian hides everything, and one that would has no gradient.
ALPHA_MOST = 0.99
STOP = 1e-4  # of the light: what lies behind is not seen
SUMS = 9

STRIPS = 4
STRIP = LANES  # pixels
PIXELS = TILE * TILE
KEPT = 2 * STRIP  # floats kept of a Gaussian in a strip between the passes: alphas, and the light before it

_I64 = ir.IntType(64)
_TO_2 = -0.5 / np.log(2.0)  # of a Gaussian's quadratic form: to the power of 2 instead of e
_F0, _HALF = np.float32(0.0), np.float32(0.5)
_LAST, _SLACK = np.float32(TILE - 1), np.float32(1e-3)  # pixels


@part
def sort_into_strips(lists, b, begin, end, projected, y0, who, count):
    """Which pairs of a tile's list lists.pair[b, begin:end] reach which strip. who: int32 (STRIPS, N),
    written: the pairs, front to back; count: int64 (STRIPS,), how many."""
    n0 = n1 = n2 = n3 = 0
    for j in range(begin, end):
        p = lists.pair[b, j]
        i = lists.owner[b, p]
        middle = projected[b, i, MY] - np.float32(y0) - _HALF
        reach = projected[b, i, HALF_HEIGHT] + _SLACK
        # Rows from 0 to 7; the ends are inside by the way the tile's list was made.
        top = np.int64(min(max(np.ceil(middle - reach), _F0), _LAST)) >> 1
        bottom = np.int64(min(max(middle + reach, _F0), _LAST)) >> 1
        # Written in any case: a branch here would be guessed wrong too often.
        who[0, n0], who[1, n1], who[2, n2], who[3, n3] = p, p, p, p
        n0 += np.int64(top == 0)
        n1 += np.int64((top <= 1) & (bottom >= 1))
        n2 += np.int64((top <= 2) & (bottom >= 2))
        n3 += np.int64(bottom == 3)
    count[0], count[1], count[2], count[3] = n0, n1, n2, n3


class _Strip:
    """What both passes need: a strip's pixels, and pointers into arrays."""

    def __init__(self, context: Any, builder: Any, signature: Any, args: Any) -> None:
        self.context, self.builder = context, builder
        self.kinds, self.args = signature.args, args

    def data(self, n: int) -> Any:
        """Of an argument that is an array."""
        return self.context.make_array(self.kinds[n])(self.context, self.builder, self.args[n]).data

    def at(self, data: Any, *numbers: Any) -> Any:
        """A pointer to the element that lies the sum of the numbers further on."""
        place = self.builder.gep(data, [numbers[0]])
        for n in numbers[1:]:
            place = self.builder.gep(place, [n if not isinstance(n, int) else _I64(n)])
        return place

    def variables(self, wides: list[Wide]) -> list[Any]:
        """What changes in a loop; LLVM keeps them in registers."""
        found = [cgutils.alloca_once(self.builder, w.value.type) for w in wides]
        self.set(found, wides)
        return found

    def get(self, variables: list[Any]) -> list[Wide]:
        return [Wide(self.builder, self.builder.load(v)) for v in variables]

    def set(self, variables: list[Any], wides: list[Wide]) -> None:
        for variable, wide in zip(variables, wides, strict=True):
            self.builder.store(wide.value, variable)

    def pixels(self, x0: Any, y0: Any) -> tuple[Wide, Wide]:
        """Their middles."""
        across = Wide(self.builder, constant(*(k % TILE + 0.5 for k in range(STRIP))))
        down = Wide(self.builder, constant(*(k // TILE + 0.5 for k in range(STRIP))))
        return across + Wide.spread(self.builder, x0), down + Wide.spread(self.builder, y0)

    def number(self, data: Any, n: Any) -> Any:
        """The n-th of int32, as int64."""
        return self.builder.sext(self.builder.load(self.at(data, n)), _I64)

    def row(self, rows: Any, owners: Any, pair: Any) -> Any:
        """Where a pair's projected Gaussian lies."""
        return self.at(rows, self.builder.mul(self.number(owners, pair), _I64(PROJECTED)))

    def columns(self, row: Any, *which: int) -> list[Wide]:
        """Of a projected Gaussian."""
        return [Wide.spread(self.builder, self.builder.load(self.at(row, _I64(k)))) for k in which]


@intrinsic
def lay(typingctx: Any, who: Any, count: Any, owner: Any, projected: Any, x0: Any, y0: Any, tile: Any,
        first: Any, kept: Any, step: Any) -> Any:  # fmt: skip
    """Lay the Gaussians of the pairs who[:count] (int32; owner[pair], int32, is a row of projected, float32
    (N, PROJECTED)) one behind the other over the strip whose first pixel's corner is (x0, y0), float32. tile:
    float32 rows of PIXELS, of which lane ``first`` and the 15 after it are the strip's: light, red, green,
    blue, depth, read and written. Alphas and the light before each Gaussian go to kept[step * n:], 2 * STRIP
    floats.

    Returns how many were laid before it was dark.
    """
    contiguous(who, owner, projected, tile, kept)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        strip = _Strip(context, builder, signature, args)
        who_data, owners, rows, tile_data, kept_data = (strip.data(n) for n in (0, 2, 3, 6, 8))
        _, count, _, _, x0, y0, _, first, _, step = args
        x, y = strip.pixels(x0, y0)
        places = [strip.at(tile_data, first, PIXELS * k) for k in range(5)]
        state = strip.variables([Wide.load(builder, place) for place in places])
        laid = cgutils.alloca_once_value(builder, count)
        with cgutils.for_range(builder, count) as loop:
            row = strip.row(rows, owners, strip.number(who_data, loop.index))
            mx, my, qa, qb, qc, alpha = strip.columns(row, MX, MY, QA, QB, QC, ALPHA)
            light, *colors = strip.get(state)
            dx, dy = x - mx, y - my
            form = dx * (dx * qa + (dy + dy) * qb) + (dy * qc) * dy
            a = ((form * _TO_2).power_of_2() * alpha).most(ALPHA_MOST)
            a = a.where(both(builder, a.at_least(ALPHA_LEAST), light.at_least(STOP)))
            keep = strip.at(kept_data, builder.mul(loop.index, step))
            a.store(keep)
            light.store(strip.at(keep, _I64(STRIP)))
            weight = a * light
            light = light - weight
            shades = strip.columns(row, RED, RED + 1, RED + 2, DEPTH)
            strip.set(state, [light, *(c + weight * s for c, s in zip(colors, shades, strict=True))])
            with builder.if_then(builder.not_(anywhere(builder, light.at_least(STOP))), likely=False):
                builder.store(builder.add(loop.index, _I64(1)), laid)
                loop.do_break()
        for place, wide in zip(places, strip.get(state), strict=True):
            wide.store(place)
        return builder.load(laid)

    f32, i64 = types.float32, types.int64
    return i64(who, i64, owner, projected, f32, f32, tile, i64, kept, i64), codegen


@intrinsic
def lift(typingctx: Any, who: Any, count: Any, owner: Any, projected: Any, x0: Any, y0: Any, slopes: Any,
         first: Any, kept: Any, sums: Any) -> Any:  # fmt: skip
    """The gradient of ``lay``, back to front. slopes: float32 rows of PIXELS: d loss / d red, green and blue,
    and what the pixel's colour behind all Gaussians has to do with it. Added to the pairs' sums, float32
    (P, SUMS); see ``splat_back.back``."""
    contiguous(who, owner, projected, slopes, kept, sums)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        strip = _Strip(context, builder, signature, args)
        who_data, owners, rows, slope_data, kept_data, sum_data = (strip.data(n) for n in (0, 2, 3, 6, 8, 9))
        _, count, _, _, x0, y0, _, first, _, _ = args
        x, y = strip.pixels(x0, y0)
        er, eg, eb, behind = (Wide.load(builder, strip.at(slope_data, first, PIXELS * k)) for k in range(4))
        state = strip.variables([behind])
        with cgutils.for_range(builder, count) as loop:
            n = builder.sub(builder.sub(count, _I64(1)), loop.index)
            pair = strip.number(who_data, n)
            row = strip.row(rows, owners, pair)
            mx, my, red, green, blue = strip.columns(row, MX, MY, RED, RED + 1, RED + 2)
            keep = strip.at(kept_data, builder.mul(n, _I64(KEPT)))
            a, light = Wide.load(builder, keep), Wide.load(builder, strip.at(keep, _I64(STRIP)))
            (behind,) = strip.get(state)
            dx, dy = x - mx, y - my
            weight, shade = a * light, er * red + eg * green + eb * blue
            h = (a * (light * shade - behind / a.rest())).where(a.below(ALPHA_MOST))
            strip.set(state, [behind + weight * shade])
            hx, hy = h * dx, h * dy
            total = strip.at(sum_data, builder.mul(pair, _I64(SUMS)))
            eight = eight_sums([h, hx, hy, hx * dx, hx * dy, hy * dy, weight * er, weight * eg])
            place = builder.bitcast(total, eight.type.as_pointer())
            old = builder.load(place)
            old.align = 4
            builder.store(builder.fadd(old, eight), place).align = 4
            last = strip.at(total, _I64(SUMS - 1))
            builder.store(builder.fadd(builder.load(last), sum_of(weight * eb)), last)
        return context.get_dummy_value()

    f32, i64 = types.float32, types.int64
    return types.void(who, i64, owner, projected, f32, f32, slopes, i64, kept, sums), codegen
