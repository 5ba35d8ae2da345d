"""Explicit SIMD for the code of numba intrinsics: vectors of float32 whose operators emit instructions.

LLVM would vectorize only some of the loops that these replace. A vector of 16 takes one register with AVX-512 and
two with AVX2.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError

from edge_server.fields.common.kernels.jit import FAST

LANES = 16
_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INTEGERS = ir.VectorType(ir.IntType(32), LANES)
_FLAGS = tuple(sorted(FAST))

# 2^r for r within [-1/2, 1/2], relative error below 3e-7: minimax, found by reweighted least squares.
_EXP2 = (1.3276472e-3, 9.675541e-3, 5.5507131e-2, 0.2402212, 0.69314694, 1.0000001)
_MIN_EXPONENT = -64.0


def constant(*numbers: float) -> ir.Constant:
    """A constant of 16 lanes: one number for all, or one for each."""
    return ir.Constant(_VECTOR, [float(n) for n in (numbers * LANES if len(numbers) == 1 else numbers)])


def _kind(lanes: int) -> ir.VectorType:
    return ir.VectorType(ir.FloatType(), lanes)


class Vector:
    """Float32 lanes, 16 unless said otherwise. ``+ - *`` and ``/`` take another vector, or a number for all 16."""

    def __init__(self, builder: Any, value: Any) -> None:
        self.builder, self.value = builder, value

    @classmethod
    def load(cls, builder: Any, pointer: Any, lanes: int = LANES) -> Vector:
        """Load numbers from a float pointer."""
        value = builder.load(builder.bitcast(pointer, _kind(lanes).as_pointer()))
        value.align = 4
        return cls(builder, value)

    @classmethod
    def broadcast(cls, builder: Any, number: Any, lanes: int = LANES) -> Vector:
        """A vector with a float value in all lanes."""
        undefined = ir.Constant(_kind(lanes), ir.Undefined)
        first = builder.insert_element(undefined, number, ir.IntType(32)(0))
        same = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
        return cls(builder, builder.shuffle_vector(first, undefined, same))

    @classmethod
    def pair(cls, builder: Any, a: Any, b: Any) -> Vector:
        """Two lanes."""
        first = builder.insert_element(ir.Constant(_kind(2), ir.Undefined), a, ir.IntType(32)(0))
        return cls(builder, builder.insert_element(first, b, ir.IntType(32)(1)))

    def store(self, pointer: Any) -> None:
        self.builder.store(self.value, self.builder.bitcast(pointer, self.value.type.as_pointer())).align = 4

    def _binary(self, operation: str, other: Vector | float) -> Vector:
        operand = other.value if isinstance(other, Vector) else constant(other)
        return Vector(self.builder, getattr(self.builder, operation)(self.value, operand, flags=_FLAGS))

    def __add__(self, other: Vector | float) -> Vector:
        return self._binary("fadd", other)

    def __sub__(self, other: Vector | float) -> Vector:
        return self._binary("fsub", other)

    def __mul__(self, other: Vector | float) -> Vector:
        return self._binary("fmul", other)

    def __truediv__(self, other: Vector | float) -> Vector:
        return self._binary("fdiv", other)

    def one_minus(self) -> Vector:
        return Vector(self.builder, constant(1.0)) - self

    def greater_equal(self, bound: float) -> Any:
        """A mask of the lanes that are >= ``bound``; NaN is not."""
        return self.builder.fcmp_ordered(">=", self.value, constant(bound))

    def less(self, bound: float) -> Any:
        """A mask of the lanes that are < ``bound``; NaN is not."""
        return self.builder.fcmp_ordered("<", self.value, constant(bound))

    def where(self, mask: Any, other: Vector | float = 0.0) -> Vector:
        """This vector where the mask is set, ``other`` elsewhere."""
        operand = other.value if isinstance(other, Vector) else constant(other)
        return Vector(self.builder, self.builder.select(mask, self.value, operand))

    def minimum(self, bound: float) -> Vector:
        """The minimum of this and ``bound``; ``bound`` for NaN."""
        return self.where(self.less(bound), bound)

    def maximum(self, bound: float) -> Vector:
        """The maximum of this and ``bound``; ``bound`` for NaN."""
        return self.where(self.greater_equal(bound), bound)

    def _llvm(self, name: str, value: Any) -> Any:
        kind = ir.FunctionType(_VECTOR, [_VECTOR])
        called = cgutils.get_or_insert_function(self.builder.module, kind, f"llvm.{name}.v{LANES}f32")
        return self.builder.call(called, [value])

    def exp2(self) -> Vector:
        """2 to the power of this, clamped to [-64, 0] (NaN: -64); relative error below 3e-7."""
        builder = self.builder
        clamped = self.maximum(_MIN_EXPONENT).minimum(0.0)
        nearest = self._llvm("rint", clamped.value)
        whole = Vector(builder, nearest)
        left = clamped - whole
        power = left * _EXP2[0] + _EXP2[1]
        for coefficient in _EXP2[2:]:
            power = power * left + coefficient
        # The exponent of a float32 begins at bit 23.
        moved = builder.shl(builder.fptosi(nearest, _INTEGERS), ir.Constant(_INTEGERS, [23] * LANES))
        raised = builder.add(builder.bitcast(power.value, _INTEGERS), moved)
        return Vector(builder, builder.bitcast(raised, _VECTOR))


def require_contiguous(*kinds: Any) -> None:
    """Refuse to compile for anything but contiguous arrays: the emitted pointers ignore strides."""
    for kind in kinds:
        if not (isinstance(kind, types.Array) and kind.layout == "C"):
            raise TypingError(f"vectors take contiguous arrays, not {kind}")


def any_lane(builder: Any, mask: Any) -> Any:
    bits = ir.IntType(LANES)
    return builder.icmp_unsigned("!=", builder.bitcast(mask, bits), bits(0))


def lane_sum(vector: Vector) -> Any:
    """The sum of a vector's lanes, a float."""
    builder, value, lanes = vector.builder, vector.value, LANES
    while lanes > 1:
        lanes //= 2
        halves = [
            builder.shuffle_vector(
                value,
                ir.Constant(value.type, ir.Undefined),
                ir.Constant(ir.VectorType(ir.IntType(32), lanes), list(range(k * lanes, (k + 1) * lanes))),
            )
            for k in (0, 1)
        ]
        value = builder.fadd(*halves, flags=_FLAGS)
    return builder.extract_element(value, ir.IntType(32)(0))


def eight_lane_sums(vectors: Sequence[Vector]) -> Any:
    """The lane sums of eight vectors, as a vector of eight floats: a third of the cost of one by one."""
    builder = vectors[0].builder
    values = [w.value for w in vectors]

    def picked(a: Any, b: Any, order: list[int]) -> Any:
        return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(order)), order))

    def merged(a: Any, b: Any, low: list[int], high: list[int]) -> Any:
        return builder.fadd(picked(a, b, low), picked(a, b, high), flags=_FLAGS)

    def each_four(order: list[int]) -> list[int]:
        # Shuffles within four lanes are the cheap ones. Numbers 4 to 7 mean lanes of the second vector.
        return [group + (k if k < 4 else k - 4 + LANES) for group in range(0, LANES, 4) for k in order]

    pairs = [merged(values[k], values[k + 1], each_four([0, 4, 1, 5]), each_four([2, 6, 3, 7])) for k in range(0, 8, 2)]
    fours = [merged(pairs[k], pairs[k + 1], each_four([0, 1, 4, 5]), each_four([2, 3, 6, 7])) for k in range(0, 4, 2)]
    first, second = list(range(8)), list(range(8, 16))
    folded = merged(*fours, first + [k + LANES for k in first], second + [k + LANES for k in second])
    one = [*range(0, 4), *range(8, 12)]
    return merged(folded, folded, one, [k + 4 for k in one])
