"""An explicit grid of density and colour without a network: rays forward and back in one pass.

A vertex is four float32 (optical depth of one step, red, green, blue), x fastest, so that one load brings
two neighbours (``voxel_quads``). A step is one vertex spacing, in contracted space too: a sample's optical
depth is the interpolated density itself, alpha = 1 - exp(-density) (thesis 3.20-3.22).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.kernels.rays import interval, pixel_direction
from edge_server.fields.common.kernels.simd import exp32, fetch_add, is_finite, uniform
from edge_server.fields.common.kernels.train import take_pixel
from edge_server.fields.voxel.kernels.cell_quads import add_to_cell, cell_value

SEGMENT = 8  # vertices a dirty flag stands for
ROOM = 2048  # samples of a ray at most
THROUGH = 1e-3  # transmittance at which a ray ends
GROUP = 256  # rays a rendering task

# Of a sample, in Trace.line: where in its cell, colour, weight, transmittance behind it, distance.
_X, _Y, _Z, _R, _G, _B, _W, _AFTER, _T = range(9)

_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_BYTE = np.float32(1.0 / 255.0)
_TOUCHED = np.float32(1e-20)  # in a gradient that would be nothing: the vertex was looked at


class Clearing(NamedTuple):
    """Where samples are taken. away: uint8 (cells^3,), x fastest: 0 where something may be, else how many
    cells it is to the nearest such cell, diagonals counting one. step, near: float32, scene units;
    contracted: whether space goes on beyond the box."""

    away: NDArray[np.uint8]
    cells: int
    contracted: bool
    step: np.float32
    near: np.float32


class Voxels(NamedTuple):
    """size: vertices a side of the unit cube. table: float32 (size^3 rounded up to SEGMENT, 4)."""

    size: int
    table: NDArray[np.float32]


class Trace(NamedTuple):
    """Memory of each worker, W of them: the samples of one ray. row: int64 (W, ROOM), a sample's lowest
    vertex. line: float32 (W, ROOM, 9). ray: float32 (W, 12), see ``train.take_pixel``."""

    row: NDArray[np.int64]
    line: NDArray[np.float32]
    ray: NDArray[np.float32]


@part
def trace(space, voxels, ox, oy, oz, dx, dy, dz, t, leave, row, line):
    """Sample a ray from distance t until it leaves or is opaque; fills row (ROOM,) and line (ROOM, 9).
    Returns (samples, transmittance, red, green, blue, distance), the last four times their weights."""
    cells, size = space.cells, voxels.size
    f_cells, f_size = np.float32(cells), np.float32(size - 1)
    scale = np.float32(0.25) if space.contracted else _HALF
    # Steps until the ray may be a cell's width farther along one of the axes.
    steps = _F1 / (f_cells * scale * space.step * max(abs(dx), max(abs(dy), abs(dz))))
    below_one, end = np.float32(0.9999999), np.float32(THROUGH)
    through, red, green, blue, far = _F1, _F0, _F0, _F0, _F0
    n = np.int64(0)
    while t < leave and n < row.size:
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        step, inside = space.step, True
        if space.contracted:
            m = max(abs(px), max(abs(py), abs(pz)))
            if m > _F1:
                inside = False
                step *= m * m  # equal steps in contracted space
                s = (np.float32(2.0) - _F1 / m) / m
                px, py, pz = px * s, py * s, pz * s
        ux = min(max(px * scale + _HALF, _F0), below_one)
        uy = min(max(py * scale + _HALF, _F0), below_one)
        uz = min(max(pz * scale + _HALF, _F0), below_one)
        cx, cy, cz = np.int64(ux * f_cells), np.int64(uy * f_cells), np.int64(uz * f_cells)
        away = space.away[cx + cells * (cy + cells * cz)]
        if away == 0:
            gx, gy, gz = ux * f_size, uy * f_size, uz * f_size
            vx, vy, vz = min(np.int64(gx), size - 2), min(np.int64(gy), size - 2), min(np.int64(gz), size - 2)
            fx, fy, fz = gx - np.float32(vx), gy - np.float32(vy), gz - np.float32(vz)
            first = vx + size * (vy + size * vz)
            density, r, g, b = cell_value(voxels.table, first, size, fx, fy, fz)
            after = through * exp32(-density)
            w = through - after
            through = after
            red += w * r
            green += w * g
            blue += w * b
            far += w * t
            row[n] = first
            line[n, _X], line[n, _Y], line[n, _Z] = fx, fy, fz
            line[n, _R], line[n, _G], line[n, _B] = r, g, b
            line[n, _W], line[n, _AFTER], line[n, _T] = w, after, t
            n += 1
            if not through >= end:  # NaN ends a ray too
                break
        elif away > 1 and inside:
            step *= max(np.floor(np.float32(away - 1) * steps), _F1)  # stay on the ray's own raster
        t += step
    return n, through, red, green, blue, far


@part
def spread(row, line, n, size, d_r, d_g, d_b, total, d_solid, gradient, dirty):
    """Add a ray's gradient to the vertices of its n samples, and flag their segments.

    d_r, d_g, d_b: of the loss with respect to the ray's colour; total: that colour times them. d_solid: of
    the loss with respect to the ray's optical depth as a whole. gradient: float32 like the table; dirty:
    uint8 (vertices / SEGMENT,).
    """
    done = _F0
    for s in range(n):
        w, after = line[s, _W], line[s, _AFTER]
        shade = d_r * line[s, _R] + d_g * line[s, _G] + d_b * line[s, _B]
        done += w * shade
        # What a thicker sample adds of its own colour, less what it takes from all behind it.
        d_depth = shade * after - (total - done) + d_solid
        if d_depth == _F0:
            d_depth = _TOUCHED
        first = row[s]
        add_to_cell(gradient, first, size, line[s, _X], line[s, _Y], line[s, _Z],
                    d_depth, w * d_r, w * d_g, w * d_b)  # fmt: skip
        y, z = first + size, first + size * size
        dirty[first // SEGMENT] = 1
        dirty[(first + 1) // SEGMENT] = 1
        dirty[y // SEGMENT] = 1
        dirty[(y + 1) // SEGMENT] = 1
        dirty[z // SEGMENT] = 1
        dirty[(z + 1) // SEGMENT] = 1
        dirty[(z + size) // SEGMENT] = 1
        dirty[(z + size + 1) // SEGMENT] = 1


@part
def choose(views, recipe, n, rays, shift):
    """The pixel of the n-th of ``rays`` rays: one at random of the n-th of as many equal runs of pixels,
    so that neighbouring rays meet the same voxels while these are in the cache. The first rays are drawn
    from all pixels that count, the last (share recipe.changed_share) from those that changed."""
    whole = rays
    if views.changed.size > 0:
        whole = rays - np.int64(np.float64(rays) * np.float64(recipe.changed_share))
    k = np.uint64(n) * np.uint64(8)
    # 48 bits: float32 cannot count the pixels of a hundred pictures.
    part = np.float64(uniform(recipe.key, k))
    part += np.float64(uniform(recipe.key, k + np.uint64(1))) * 5.9604644775390625e-08
    if n < whole:
        total = views.drawn.size if views.drawn.size > 0 else views.pixels.shape[0]
        # Runs are shifted around at every step: none begins at the same pixel again and again.
        at = (np.int64((np.float64(n) + part) / np.float64(whole) * total) + shift) % total
        return views.drawn[at] if views.drawn.size > 0 else at
    total = views.changed.size
    at = np.int64((np.float64(n - whole) + part) / np.float64(rays - whole) * total)
    return views.changed[min(at, total - 1)]


@kernel
def train_rays(counter, worker, views, recipe, space, voxels, rays, outline, memory, gradient, dirty, samples,
               dropped, loss):  # fmt: skip
    """Forward and backward of ``rays`` rays. A task is a run of them with gradient[p] and dirty[p] to
    itself, P of them whatever the number of workers: sums have the same order on every machine.
    outline: weight of the error of opacity, where pictures have an alpha channel.
    samples, dropped: int64 (P,); loss: float64 (P,), the squared error summed over rays and channels."""
    parts = gradient.shape[0]
    ray, row, line = memory.ray[worker], memory.row[worker], memory.line[worker]
    shift = np.int64(recipe.key >> np.uint64(40)) % max(views.pixels.shape[0], 1)
    two = np.float32(2.0)
    while True:
        part = fetch_add(counter, 1)
        if part >= parts:
            return
        count = bad = 0
        error = 0.0
        for n in range(part * rays // parts, (part + 1) * rays // parts):
            pixel = choose(views, recipe, n, rays, shift)
            view = take_pixel(views, recipe, pixel, n, ray)
            o = views.origin[view]
            ox, oy, oz = np.float32(o[0]), np.float32(o[1]), np.float32(o[2])
            enter, leave = interval(space, ox, oy, oz, ray[0], ray[1], ray[2])
            enter += _HALF * space.step
            k, through, red, green, blue, _ = trace(
                space, voxels, ox, oy, oz, ray[0], ray[1], ray[2], enter, leave, row, line
            )
            red += through * ray[6]
            green += through * ray[7]
            blue += through * ray[8]
            d_r, d_g, d_b = red - ray[3], green - ray[4], blue - ray[5]
            trust = ray[10] if views.weight.size > 0 else _F1
            e = trust * (d_r * d_r + d_g * d_g + d_b * d_b)
            count += k
            if not is_finite(e):
                bad += 1
                continue
            error += e
            d_r, d_g, d_b = two * trust * d_r, two * trust * d_g, two * trust * d_b
            total = d_r * red + d_g * green + d_b * blue
            d_solid = _F0
            if outline > _F0 and views.pixels.shape[1] == 4:
                # What a random background would teach on average, without its noise.
                alpha = np.float32(views.pixels[pixel, 3]) * _BYTE
                d_solid = two * trust * outline * (_F1 - through - alpha) * through
            spread(row, line, k, voxels.size, d_r, d_g, d_b, total, d_solid, gradient[part], dirty[part])
        samples[part], dropped[part], loss[part] = count, bad, error


@kernel
def render_rays(counter, worker, lens, rotation, origin, pixels, space, voxels, background, memory, color,
                depth, opacity):  # fmt: skip
    """pixels: float64 (N, 2), image points. color: float32 (N, 3), depth (scene units) and opacity: (N,),
    all written."""
    row, line = memory.row[worker], memory.line[worker]
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    while True:
        first = fetch_add(counter, 1) * GROUP
        if first >= pixels.shape[0]:
            return
        for p in range(first, min(first + GROUP, pixels.shape[0])):
            dx, dy, dz = pixel_direction(lens, rotation, pixels[p, 0], pixels[p, 1])
            enter, leave = interval(space, ox, oy, oz, dx, dy, dz)
            _, through, red, green, blue, far = trace(
                space, voxels, ox, oy, oz, dx, dy, dz, enter + _HALF * space.step, leave, row, line
            )
            solid = _F1 - through
            good = is_finite(red + green + blue + far + solid)
            shade = (red, green, blue)
            for c in range(3):
                mixed = shade[c] + through * background[c] if good else background[c]
                color[p, c] = min(max(mixed, _F0), _F1)
            opacity[p] = min(max(solid, _F0), _F1) if good else _F0
            depth[p] = far / solid if good and solid > np.float32(1e-3) else _F0
