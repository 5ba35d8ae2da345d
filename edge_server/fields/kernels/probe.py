"""What a machine can do at most: random reads of, and additions to, vertices of two float32."""

from __future__ import annotations

import numpy as np

from edge_server.fields.kernels.intrinsics import fetch_add
from edge_server.fields.kernels.jit import kernel

TASKS, PER_TASK = 64, 1 << 16


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
