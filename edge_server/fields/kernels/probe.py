"""What a machine can do at most: random reads of, and additions to, vertices of two float32, divisions, and
copies within a core's own cache."""

from __future__ import annotations

import numpy as np

from edge_server.fields.kernels.intrinsics import fetch_add
from edge_server.fields.kernels.jit import kernel

TASKS, PER_TASK = 64, 1 << 16
ROUNDS = 64  # of short loops in one task: drawing its number would be what is measured


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
