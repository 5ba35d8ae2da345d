"""Which cells of space get samples: those that enough cameras see and that are not known to be empty."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.radiance_model import query_density
from edge_server.fields.common.kernels.rays import COARSE
from edge_server.fields.common.kernels.simd import exp32, fetch_add, is_finite, uniform
from edge_server.fields.common.kernels.volume_rendering import RAW_HIGH, RAW_LOW

CELLS_A_TASK = 2048  # at most train.CHUNK: they share its scratch


@device_function
def cell_centre(index, cells, contracted):
    """Center of a cell in scene units (contraction undone) and how much longer a step is there."""
    i, j, k = index % cells, (index // cells) % cells, index // (cells * cells)
    half = 2.0 if contracted else 1.0
    scale = 2.0 * half / cells
    x, y, z = (i + 0.5) * scale - half, (j + 0.5) * scale - half, (k + 0.5) * scale - half
    m = max(abs(x), max(abs(y), abs(z)))
    if contracted and m > 1.0:
        far = 1.0 / (2.0 - m)
        s = far / m
        return x * s, y * s, z * s, far * far
    return x, y, z, 1.0


@kernel
def count_views(counter, worker, cells, contracted, near, views, mask_first, mask, seen, marked):
    """For each cell, how many cameras see its center from farther than ``near``.

    mask: uint8, a flag for each pixel of the views that have a mask, of view v from mask_first[v] on.
    mask_first: int64 (V,), -1: no mask. seen: uint16 (cells^3,), the count.
    marked: uint16 (cells^3,), how many cameras see the cell at a flagged pixel.
    Lens distortion is left out: it moves a cell's center by less than a cell.
    """
    tasks = (seen.size + CELLS_A_TASK - 1) // CELLS_A_TASK
    while True:
        task = fetch_add(counter, 1)
        if task >= tasks:
            return
        for cell in range(task * CELLS_A_TASK, min((task + 1) * CELLS_A_TASK, seen.size)):
            x, y, z, _ = cell_centre(cell, cells, contracted)
            count, flags = 0, 0
            for v in range(views.origin.shape[0]):
                px, py, pz = x - views.origin[v, 0], y - views.origin[v, 1], z - views.origin[v, 2]
                r = views.rotation[v]
                depth = r[0, 2] * px + r[1, 2] * py + r[2, 2] * pz
                if depth <= near:
                    continue
                lens = views.lens[v]
                column = lens[0] * (r[0, 0] * px + r[1, 0] * py + r[2, 0] * pz) / depth + lens[2]
                row = lens[1] * (r[0, 1] * px + r[1, 1] * py + r[2, 1] * pz) / depth + lens[3]
                width, height = views.size[v, 0], views.size[v, 1]
                if 0.0 <= column < width and 0.0 <= row < height:
                    count += 1
                    if mask_first[v] >= 0:
                        flags += mask[mask_first[v] + np.int64(row) * width + np.int64(column)]
            seen[cell], marked[cell] = count, flags


@kernel
def sample_density(
    counter,
    worker,
    key,
    phase,
    phases,
    fade,
    encoding,
    levels,
    net,
    cells,
    contracted,
    seen,
    min_views,
    density,
    acts,
    x,
):
    """Refresh every ``phases``-th cell's density: the larger of the faded old one and a new random sample.

    key: uint64, random stream. seen: uint16 (cells^3,); cells seen by fewer than min_views get 0.
    density: float32 (cells^3,), per scene unit, times how much longer steps are where space is contracted.
    acts: float32 (W, units, CHUNK) and x: float32 (W, 3, CHUNK), scratch.
    """
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
            _, _, _, stretch = cell_centre(cell, cells, contracted)
            fresh = sigma * np.float32(stretch)
            # A density that is not finite: sample the cell again, and let training repair it.
            density[cell] = max(density[cell] * fade, fresh) if is_finite(fresh) else np.float32(1e3)
            n += 1


@kernel
def threshold(density, seen, min_views, bound, cells, occupied, coarse):
    """Mark the cells whose density reaches ``bound``, but never more than .7 of the mean over seen cells:
    a bound that is wrong for the scene must not empty it. Fills occupied and coarse (uint8)."""
    total, count = 0.0, 0
    for cell in range(density.size):
        if seen[cell] >= min_views:
            total += min(density[cell], 10.0 * bound)
            count += 1
    bound = min(bound, 0.7 * total / max(count, 1))
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
