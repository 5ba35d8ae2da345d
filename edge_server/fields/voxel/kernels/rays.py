"""Rays through an explicit grid of density and color, without a network: forward and backward in one pass.

A vertex is four float32 (optical depth of one step, red, green, blue), x fastest, so that one load brings
two neighbors (``cell_quads``). A step is one vertex spacing, in contracted space too: a sample's optical
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
MAX_SAMPLES = 2048  # most samples of a ray
MIN_TRANSMITTANCE = 1e-3  # at which a ray ends
TASK_RAYS = 256  # rays a rendering task

# Columns of RayScratch.line: position in the cell, color, weight, transmittance behind the sample, distance.
_X, _Y, _Z, _R, _G, _B, _W, _AFTER, _T = range(9)

_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)
_BYTE = np.float32(1.0 / 255.0)
_TOUCHED = np.float32(1e-20)  # replaces a gradient of 0, which would mean that no ray met the vertex


class SkipGrid(NamedTuple):
    """Empty space, which rays skip.

    clearance: uint8 (cells^3,), x fastest, distance to the nearest occupied cell (0: occupied) in cells,
    diagonals counting one. step, near: scene units. contracted: whether space goes on beyond the box.
    """

    clearance: NDArray[np.uint8]
    cells: int
    contracted: bool
    step: np.float32
    near: np.float32


class Voxels(NamedTuple):
    """size: vertices a side of the unit cube. table: float32 (size^3 rounded up to SEGMENT, 4)."""

    size: int
    table: NDArray[np.float32]


class RayScratch(NamedTuple):
    """Samples of one ray, for each of W workers.

    row: int64 (W, MAX_SAMPLES), a sample's lowest vertex. line: float32 (W, MAX_SAMPLES, 9), see _X to _T.
    ray: float32 (W, 12), see ``train.take_pixel``.
    """

    row: NDArray[np.int64]
    line: NDArray[np.float32]
    ray: NDArray[np.float32]


@part
def march_ray(space, voxels, ox, oy, oz, dx, dy, dz, t, leave, row, line):
    """Sample and composite a ray from distance t until it leaves the grid or is opaque.

    Fills row (MAX_SAMPLES,) and line (MAX_SAMPLES, 9). Returns (samples, transmittance, red, green, blue,
    distance), the last four weighted.
    """
    cells, size = space.cells, voxels.size
    f_cells, f_size = np.float32(cells), np.float32(size - 1)
    scale = np.float32(0.25) if space.contracted else _HALF
    # Steps in which the ray advances at most a cell's width along any axis.
    steps = _F1 / (f_cells * scale * space.step * max(abs(dx), max(abs(dy), abs(dz))))
    below_one, end = np.float32(0.9999999), np.float32(MIN_TRANSMITTANCE)
    transmittance, red, green, blue, far = _F1, _F0, _F0, _F0, _F0
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
        clearance = space.clearance[cx + cells * (cy + cells * cz)]
        if clearance == 0:
            gx, gy, gz = ux * f_size, uy * f_size, uz * f_size
            vx, vy, vz = min(np.int64(gx), size - 2), min(np.int64(gy), size - 2), min(np.int64(gz), size - 2)
            fx, fy, fz = gx - np.float32(vx), gy - np.float32(vy), gz - np.float32(vz)
            first = vx + size * (vy + size * vz)
            density, r, g, b = cell_value(voxels.table, first, size, fx, fy, fz)
            after = transmittance * exp32(-density)
            w = transmittance - after
            transmittance = after
            red += w * r
            green += w * g
            blue += w * b
            far += w * t
            row[n] = first
            line[n, _X], line[n, _Y], line[n, _Z] = fx, fy, fz
            line[n, _R], line[n, _G], line[n, _B] = r, g, b
            line[n, _W], line[n, _AFTER], line[n, _T] = w, after, t
            n += 1
            if not transmittance >= end:  # NaN ends a ray too
                break
        elif clearance > 1 and inside:
            step *= max(np.floor(np.float32(clearance - 1) * steps), _F1)  # stay on the ray's own raster
        t += step
    return n, transmittance, red, green, blue, far


@part
def march_ray_backward(row, line, n, size, d_r, d_g, d_b, total, d_depth_total, gradient, dirty):
    """Backward of ``march_ray``: add the gradient to the vertices of n samples and flag their segments.

    d_r, d_g, d_b: gradient of the loss by the ray's color; total: its dot product with that color.
    d_depth_total: gradient by the ray's total optical depth. gradient: float32 like the table. dirty: uint8
    (vertices / SEGMENT,).
    """
    done = _F0
    for s in range(n):
        w, after = line[s, _W], line[s, _AFTER]
        shade = d_r * line[s, _R] + d_g * line[s, _G] + d_b * line[s, _B]
        done += w * shade
        # A denser sample adds its own color and takes light from all behind it.
        d_depth = shade * after - (total - done) + d_depth_total
        if d_depth == _F0:
            d_depth = _TOUCHED
        first = row[s]
        add_to_cell(gradient, first, size, line[s, _X], line[s, _Y], line[s, _Z], d_depth, w * d_r, w * d_g, w * d_b)
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
def draw_pixel(views, recipe, n, rays, shift):
    """Draw the pixel of the n-th of ``rays`` rays, at random from the n-th of ``rays`` equal runs of pixels.

    So neighboring rays meet the same voxels while these are in the cache. The first rays draw from all
    pixels in use, the last (share recipe.changed_share) from those that changed.
    """
    whole = rays
    if views.changed.size > 0:
        whole = rays - np.int64(np.float64(rays) * np.float64(recipe.changed_share))
    k = np.uint64(n) * np.uint64(8)
    # 48 bits: float32 cannot index the pixels of a hundred images.
    part = np.float64(uniform(recipe.key, k))
    part += np.float64(uniform(recipe.key, k + np.uint64(1))) * 5.9604644775390625e-08
    if n < whole:
        total = views.drawn.size if views.drawn.size > 0 else views.pixels.shape[0]
        # Runs are shifted at every step, so that their borders move.
        at = (np.int64((np.float64(n) + part) / np.float64(whole) * total) + shift) % total
        return views.drawn[at] if views.drawn.size > 0 else at
    total = views.changed.size
    at = np.int64((np.float64(n - whole) + part) / np.float64(rays - whole) * total)
    return views.changed[min(at, total - 1)]


@kernel
def train_rays(
    counter, worker, views, recipe, space, voxels, rays, outline, memory, gradient, dirty, samples, dropped, loss
):
    """Forward and backward of ``rays`` rays.

    A task is a run of rays with gradient[p] and dirty[p] of its own. There are P tasks whatever the number of
    workers, so that sums have the same order on every machine.
    outline: weight of the error of opacity, where images have an alpha channel.
    samples, dropped: int64 (P,). loss: float64 (P,), squared error summed over rays and channels.
    """
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
            pixel = draw_pixel(views, recipe, n, rays, shift)
            view = take_pixel(views, recipe, pixel, n, ray)
            o = views.origin[view]
            ox, oy, oz = np.float32(o[0]), np.float32(o[1]), np.float32(o[2])
            enter, leave = interval(space, ox, oy, oz, ray[0], ray[1], ray[2])
            enter += _HALF * space.step
            k, transmittance, red, green, blue, _ = march_ray(
                space, voxels, ox, oy, oz, ray[0], ray[1], ray[2], enter, leave, row, line
            )
            red += transmittance * ray[6]
            green += transmittance * ray[7]
            blue += transmittance * ray[8]
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
            d_depth_total = _F0
            if outline > _F0 and views.pixels.shape[1] == 4:
                # The expected gradient under a random background, without its noise.
                alpha = np.float32(views.pixels[pixel, 3]) * _BYTE
                d_depth_total = two * trust * outline * (_F1 - transmittance - alpha) * transmittance
            march_ray_backward(
                row, line, k, voxels.size, d_r, d_g, d_b, total, d_depth_total, gradient[part], dirty[part]
            )
        samples[part], dropped[part], loss[part] = count, bad, error


@kernel
def render_rays(
    counter, worker, lens, rotation, origin, pixels, space, voxels, background, memory, color, depth, opacity
):
    """Render pixels, float64 (N, 2), to color, float32 (N, 3), depth in scene units and opacity (N,)."""
    row, line = memory.row[worker], memory.line[worker]
    ox, oy, oz = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    while True:
        first = fetch_add(counter, 1) * TASK_RAYS
        if first >= pixels.shape[0]:
            return
        for p in range(first, min(first + TASK_RAYS, pixels.shape[0])):
            dx, dy, dz = pixel_direction(lens, rotation, pixels[p, 0], pixels[p, 1])
            enter, leave = interval(space, ox, oy, oz, dx, dy, dz)
            _, transmittance, red, green, blue, far = march_ray(
                space, voxels, ox, oy, oz, dx, dy, dz, enter + _HALF * space.step, leave, row, line
            )
            solid = _F1 - transmittance
            good = is_finite(red + green + blue + far + solid)
            shade = (red, green, blue)
            for c in range(3):
                mixed = shade[c] + transmittance * background[c] if good else background[c]
                color[p, c] = min(max(mixed, _F0), _F1)
            opacity[p] = min(max(solid, _F0), _F1) if good else _F0
            depth[p] = far / solid if good and solid > np.float32(1e-3) else _F0
