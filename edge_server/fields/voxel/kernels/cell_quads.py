"""Reads and updates a cell of a voxel grid as four pairs of vertices: eight float32, one register each.

Vertices that are neighbors along x are adjacent in memory, four float32 each; a cell is four such pairs.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

_QUAD, _PAIR = ir.VectorType(ir.FloatType(), 4), ir.VectorType(ir.FloatType(), 8)
_I32 = ir.IntType(32)
_LOW, _HIGH = (ir.Constant(ir.VectorType(_I32, 4), list(range(k, k + 4))) for k in (0, 4))
_BOTH = ir.Constant(ir.VectorType(_I32, 8), list(range(8)))
_FLAGS = ("contract",)


def _filled(builder: Any, kind: Any, value: Any) -> Any:
    vector = builder.insert_element(ir.Constant(kind, ir.Undefined), value, _I32(0))
    zeros = ir.Constant(ir.VectorType(_I32, kind.count), [0] * kind.count)
    return builder.shuffle_vector(vector, ir.Constant(kind, ir.Undefined), zeros)


def _pairs(context: Any, builder: Any, array_type: Any, array: Any, row: Any, size: Any) -> list[Any]:
    """Pointers to the four pairs of the cell whose lowest vertex is ``row``: by y, then z."""
    data = context.make_array(array_type)(context, builder, array).data
    quads = builder.bitcast(data, _QUAD.as_pointer())
    plane = builder.mul(size, size)
    rows = [row, builder.add(row, size), builder.add(row, plane), builder.add(builder.add(row, plane), size)]
    return [builder.bitcast(builder.gep(quads, [r]), _PAIR.as_pointer()) for r in rows]


def _mixed(builder: Any, a: Any, b: Any, share: Any) -> Any:
    way = builder.fmul(builder.fsub(b, a, flags=_FLAGS), share, flags=_FLAGS)
    return builder.fadd(a, way, flags=_FLAGS)


@intrinsic
def cell_value(typingctx: Any, table: Any, row: Any, size: Any, x: Any, y: Any, z: Any) -> Any:
    """The four channels at (x, y, z) in [0, 1] between the vertices of a cell, trilinear.

    table: contiguous float32 (N, 4), a grid of ``size`` vertices a side, x fastest; row: int64, the cell's
    lowest vertex. Returns four float32.
    """
    f32 = types.float32
    signature = types.UniTuple(f32, 4)(table, types.int64, types.int64, f32, f32, f32)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pairs = []
        for pointer in _pairs(context, builder, signature.args[0], args[0], args[1], args[2]):
            pairs.append(builder.load(pointer))
            pairs[-1].align = 4
        along_y, along_z = (_filled(builder, _PAIR, args[k]) for k in (4, 5))
        near = _mixed(builder, pairs[0], pairs[1], along_y)
        far = _mixed(builder, pairs[2], pairs[3], along_y)
        pair = _mixed(builder, near, far, along_z)
        low, high = (builder.shuffle_vector(pair, pair, part) for part in (_LOW, _HIGH))
        value = _mixed(builder, low, high, _filled(builder, _QUAD, args[3]))
        parts = [builder.extract_element(value, _I32(k)) for k in range(4)]
        return context.make_tuple(builder, signature.return_type, parts)

    return signature, codegen


@intrinsic
def add_to_cell(
    typingctx: Any, table: Any, row: Any, size: Any, x: Any, y: Any, z: Any, a: Any, b: Any, c: Any, d: Any
) -> Any:
    """Add (a, b, c, d) to a cell's vertices by their weights at (x, y, z): backward of ``cell_value``."""
    f32 = types.float32
    signature = types.void(table, types.int64, types.int64, *[f32] * 7)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        one = ir.Constant(ir.FloatType(), 1.0)
        x, y, z = args[3:6]
        value = ir.Constant(_QUAD, ir.Undefined)
        for k in range(4):
            value = builder.insert_element(value, args[6 + k], _I32(k))
        high = builder.fmul(value, _filled(builder, _QUAD, x))
        low = builder.fmul(value, _filled(builder, _QUAD, builder.fsub(one, x)))
        pair = builder.shuffle_vector(low, high, _BOTH)
        before_y, before_z = builder.fsub(one, y), builder.fsub(one, z)
        shares = [builder.fmul(v, w) for w in (before_z, z) for v in (before_y, y)]
        pointers = _pairs(context, builder, signature.args[0], args[0], args[1], args[2])
        for pointer, share in zip(pointers, shares):
            old = builder.load(pointer)
            old.align = 4
            step = builder.fmul(pair, _filled(builder, _PAIR, share), flags=_FLAGS)
            builder.store(builder.fadd(old, step, flags=_FLAGS), pointer).align = 4
        return context.get_dummy_value()

    return signature, codegen
