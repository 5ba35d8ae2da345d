"""Which cells of space get samples: those that enough cameras see and that are not known to be empty."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import field_constants as tuned
from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.radiance_model import query_density
from edge_server.fields.common.kernels.rays import COARSE
from edge_server.fields.common.kernels.simd import exp32, fetch_add, is_finite, uniform
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW

CELLS_A_TASK = 2048  # at most train.CHUNK: they share its scratch


class Cells(NamedTuple):
    """Cells of space, side^3 of them, x fastest.

    seen: uint16 (N,), how many cameras see each. needed: cameras that must see a cell.
    stretch: float32 (N,), how much longer steps are where space is contracted.
    density: float32 (N,), per scene unit, times ``stretch``; 0 in cells that too few cameras see.
    """

    side: int
    seen: NDArray[np.uint16]
    needed: int
    stretch: NDArray[np.float32]
    density: NDArray[np.float32]


@kernel
def sample_density(counter, worker, key, phase, phases, fade, encoding, levels, net, grid, acts, x):
    """Refresh every ``phases``-th cell's density: the larger of the faded old one and a new random sample.

    key: uint64, random stream. grid: ``Cells``.
    acts: float32 (W, units, ROW) and x: float32 (W, 3, ROW), scratch (``train.Scratch``).
    """
    cells, seen, min_views, density = grid.side, grid.seen, grid.needed, grid.density
    per_task = CELLS_A_TASK
    cells_here = (density.size + phases - 1 - phase) // phases
    tasks = (cells_here + per_task - 1) // per_task
    out_row = acts.shape[1] - net.widths[-1]
    size = np.float32(1.0 / cells)
    while True:
        task = fetch_add(counter, 1)
        if task >= tasks:
            return
        start = n = np.int64(0)
        first, end = task * per_task, min((task + 1) * per_task, cells_here)
        for index in range(first, end):
            cell = index * phases + phase
            if seen[cell] < min_views:
                continue
            k = np.uint64(index) * np.uint64(4)
            i, j, l = cell % cells, (cell // cells) % cells, cell // (cells * cells)
            x[worker, 0, n] = (np.float32(i) + uniform(key, k)) * size
            x[worker, 1, n] = (np.float32(j) + uniform(key, k + np.uint64(1))) * size
            x[worker, 2, n] = (np.float32(l) + uniform(key, k + np.uint64(2))) * size
            n += 1
        query_density(encoding, levels, net, x[worker], start, n, acts[worker])
        raw = acts[worker, out_row]
        n = 0
        for index in range(first, end):
            cell = index * phases + phase
            if seen[cell] < min_views:
                density[cell] = np.float32(0.0)
                continue
            sigma = exp32(min(max(raw[n], np.float32(RAW_LOW)), np.float32(RAW_HIGH)))
            fresh = sigma * grid.stretch[cell]
            # A density that is not finite: sample the cell again, and let training repair it.
            density[cell] = max(density[cell] * fade, fresh) if is_finite(fresh) else np.float32(1e3)
            n += 1


@kernel
def threshold(grid, bound, occupied, coarse):
    """Mark the cells whose density reaches ``bound``, but never more than OCCUPIED_OF_MEAN of the mean over seen cells:
    a bound that is wrong for the scene must not empty it. grid: ``Cells``. Fills occupied and coarse (uint8)."""
    cells, seen, min_views, density = grid.side, grid.seen, grid.needed, grid.density
    total, count = 0.0, 0
    for cell in range(density.size):
        if seen[cell] >= min_views:
            total += min(density[cell], tuned.OCCUPIED_MOST * bound)
            count += 1
    bound = min(bound, tuned.OCCUPIED_OF_MEAN * total / max(count, 1))
    coarse[:] = 0
    blocks = cells // COARSE
    for k in range(cells):
        for j in range(cells):
            row = cells * (j + cells * k)
            block = blocks * (j // COARSE + blocks * (k // COARSE))
            for i in range(cells):
                if seen[row + i] >= min_views and density[row + i] >= bound:
                    occupied[row + i] = 1
                    coarse[block + i // COARSE] = 1
                else:
                    occupied[row + i] = 0
