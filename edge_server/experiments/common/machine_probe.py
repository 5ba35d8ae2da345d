"""Kernels that probe the limits of a machine: random reads of and additions to vertices (two float32),
divisions, copies within a core's own cache, and arithmetic in registers."""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.simd import fetch_add

TASKS, PER_TASK = 64, 1 << 16
ROUNDS = 64  # of short loops in one task, so that fetching the task's number does not count


@kernel
def random_reads(counter, worker, table, rows, out):
    """Sum the vertices ``rows`` of one table (N, 2), TASKS times over; out: float32 (workers, 2)."""
    a = b = np.float32(0.0)
    while fetch_add(counter, 1) < TASKS:
        for i in range(rows.size):
            a += table[rows[i], 0]
            b += table[rows[i], 1]
    out[worker, 0], out[worker, 1] = a, b


@kernel
def random_adds(counter, worker, tables, rows):
    """Add to the vertices ``rows`` of the worker's own table, TASKS times over; tables (workers, N, 2)."""
    table, one = tables[worker], np.float32(1.0)
    while fetch_add(counter, 1) < TASKS:
        for i in range(rows.size):
            table[rows[i], 0] += one
            table[rows[i], 1] += one


@kernel
def divisions(counter, worker, x, y, out):
    """Divide x (N,) by y (N,) and add the quotients to out (workers, N), float32, TASKS * ROUNDS times."""
    mine = out[worker]
    while fetch_add(counter, 1) < TASKS:
        for _ in range(ROUNDS):
            for i in range(x.size):
                mine[i] += x[i] / y[i]


@kernel
def copies(counter, worker, memory):
    """Copy the first half of the worker's memory (workers, 2 N), float32, to its second, TASKS times over."""
    mine = memory[worker]
    half = mine.size // 2
    while fetch_add(counter, 1) < TASKS:
        for i in range(half):
            mine[half + i] = mine[i] + np.float32(1.0)


# (lanes of a vector, multiply-adds, additions) of each probe: chains of operations, each of which waits for
# its predecessor. They are enough to keep all units of a core busy and fit into its registers. Some cores
# have units of their own for additions; those with 16 lanes have 32 registers instead of 16.
CHAINS = ((8, 12, 0), (8, 7, 7), (16, 12, 0), (16, 12, 12))
CHAINED = 200_000  # operations of each chain in one task


def _chains(lanes: int, multiply_adds: int, additions: int) -> Any:
    """A kernel that does nothing but arithmetic in registers; its result goes to out[worker]."""
    vector = ir.VectorType(ir.FloatType(), lanes)

    def spread(builder: Any, number: Any) -> Any:
        undefined = ir.Constant(vector, ir.Undefined)
        first = builder.insert_element(undefined, number, ir.IntType(32)(0))
        zeros = ir.Constant(ir.VectorType(ir.IntType(32), lanes), [0] * lanes)
        return builder.shuffle_vector(first, undefined, zeros)

    @intrinsic
    def chained(typingctx: Any, count: Any, number: Any) -> Any:
        def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            step = spread(builder, args[1])
            chains = [cgutils.alloca_once(builder, vector) for _ in range(multiply_adds + additions)]
            for k, chain in enumerate(chains):
                # From 2 on: 1 * 1/2 + 1/2 is 1 again, and the compiler would leave that chain out.
                builder.store(spread(builder, ir.FloatType()(float(k + 2))), chain)
            with cgutils.for_range(builder, args[0]):
                for k, chain in enumerate(chains):
                    value = builder.load(chain)
                    if k < multiply_adds:
                        value = builder.fmul(value, step, flags=("contract",))
                    builder.store(builder.fadd(value, step, flags=("contract",)), chain)
            total = spread(builder, ir.FloatType()(0.0))
            for chain in chains:
                total = builder.fadd(total, builder.load(chain))
            result = ir.FloatType()(0.0)
            for k in range(lanes):
                result = builder.fadd(result, builder.extract_element(total, ir.IntType(32)(k)))
            return result

        return types.float32(types.int64, types.float32), codegen

    def arithmetic(counter, worker, out):
        total = np.float32(0.0)
        while fetch_add(counter, 1) < TASKS:
            total += chained(np.int64(CHAINED), np.float32(0.5))
        out[worker] = total

    arithmetic.__qualname__ = f"arithmetic_{lanes}_{multiply_adds}_{additions}"
    return kernel(arithmetic)


arithmetic = tuple(_chains(*shape) for shape in CHAINS)
