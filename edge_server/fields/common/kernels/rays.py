"""From a pixel to the samples of its ray: lens, pose, the scene's box, contraction and occupancy grid.

Scene coordinates: the box of interest is [-1, 1]^3. Where the scene goes on beyond it, space is contracted
(Barron et al. 2022, with the maximum norm): |x| > 1 becomes (2 - 1/|x|) x/|x|, so that all of it lies in
[-2, 2]^3. The encoding's unit cube is that cube (or the box itself) scaled.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.jit import device_function
from edge_server.fields.field_constants import HORIZON

COARSE = 4  # cells of the occupancy grid a side of one cell of its coarse copy
NEVER = np.float32(1e30)


class Space(NamedTuple):
    """Where samples are taken.

    occupied: uint8 (cells^3,), x fastest; coarse: the same for blocks of COARSE^3 cells.
    density: float32 (cells^3,), see ``occupancy``; read only if a ray is to end early.
    contracted: whether space goes on beyond the box.
    step: float32, distance between samples; near: float32, of the first one; scene units.
    """

    occupied: NDArray[np.uint8]
    coarse: NDArray[np.uint8]
    density: NDArray[np.float32]
    cells: int
    contracted: bool
    step: np.float32
    near: np.float32


class Views(NamedTuple):
    """The pictures of one fit, V of them with N pixels together, packed.

    first: int64 (V + 1,), each view's first pixel. size: int64 (V, 2), width and height.
    lens: float64 (V, 8), fx fy cx cy k1 k2 p1 p2. rotation: float64 (V, 3, 3), camera to world.
    origin: float64 (V, 3), scene units. pixels: uint8 (N, 3 or 4).
    changed: int64 (M,), pixels that moved since the camera's previous view, none of weight 0.
    weight: float32 (N,), of each pixel's loss; size 0: all 1.
    drawn: int64 (K,), the pixels of weight above 0; size 0: all of them.
    guide: float32 (N,), distance in scene units of what a pixel shows (``plane_sweep.depth_guide``), 0:
        unknown; size 0: all unknown.
    """

    first: NDArray[np.int64]
    size: NDArray[np.int64]
    lens: NDArray[np.float64]
    rotation: NDArray[np.float64]
    origin: NDArray[np.float64]
    pixels: NDArray[np.uint8]
    changed: NDArray[np.int64]
    weight: NDArray[np.float32] = np.zeros(0, np.float32)
    drawn: NDArray[np.int64] = np.zeros(0, np.int64)
    guide: NDArray[np.float32] = np.zeros(0, np.float32)


@device_function
def pixel_direction(lens, rotation, u, v):
    """Unit direction in world axes of image point (u, v): ``Pinhole.rays``, rotated, for one pixel."""
    x0, y0 = (u - lens[2]) / lens[0], (v - lens[3]) / lens[1]
    x, y = x0, y0
    k1, k2, p1, p2 = lens[4], lens[5], lens[6], lens[7]
    if k1 != 0.0 or k2 != 0.0 or p1 != 0.0 or p2 != 0.0:
        for _ in range(8):
            r2 = x * x + y * y
            radial = 1.0 + r2 * (k1 + r2 * k2)
            dx = 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
            dy = p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
            x, y = (x0 - dx) / radial, (y0 - dy) / radial
        best, kept_x, kept_y = 1e30, x, y
        for _ in range(3):  # two of Newton's steps, where they lead nearer, see Pinhole
            r2 = x * x + y * y
            radial, slope = 1.0 + r2 * (k1 + r2 * k2), 2.0 * (k1 + 2.0 * r2 * k2)
            xx = radial + slope * x * x + 2.0 * p1 * y + 6.0 * p2 * x
            xy = slope * x * y + 2.0 * p1 * x + 2.0 * p2 * y
            yy = radial + slope * y * y + 6.0 * p1 * y + 2.0 * p2 * x
            ex = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - x0
            ey = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - y0
            determinant = xx * yy - xy * xy
            if not ex * ex + ey * ey < best:
                break
            best, kept_x, kept_y = ex * ex + ey * ey, x, y
            if determinant == 0.0:
                break
            x, y = x - (yy * ex - xy * ey) / determinant, y - (xx * ey - xy * ex) / determinant
        x, y = kept_x, kept_y
    scale = 1.0 / np.sqrt(x * x + y * y + 1.0)
    x, y, z = x * scale, y * scale, scale
    return (
        np.float32(rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] * z),
        np.float32(rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] * z),
        np.float32(rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] * z),
    )


@device_function
def slab(o, d, half, enter, leave):
    if abs(d) < np.float32(1e-9):
        return (enter, leave) if abs(o) <= half else (enter, np.float32(-1.0))
    a, b = (-half - o) / d, (half - o) / d
    return max(enter, min(a, b)), min(leave, max(a, b))


@device_function
def origin_of(views, v):
    """The origin of view v as three float32."""
    o = views.origin[v]
    return np.float32(o[0]), np.float32(o[1]), np.float32(o[2])


@device_function
def interval(space, o, d):
    """Where the ray from o along d (three float32 each) enters and leaves the scene; leave <= enter if it misses
    it or is not finite: undistortion may diverge for an impossible lens, and NaN must not become the number of
    a cell."""
    (ox, oy, oz), (dx, dy, dz) = o, d
    # Not is_finite(): numba loses the name of an inlined function's own inlined callee.
    if not abs(dx + dy + dz + ox + oy + oz) <= np.float32(3.4e38):
        return np.float32(0.0), np.float32(-1.0)
    half = np.float32(HORIZON) if space.contracted else np.float32(1.0)
    enter, leave = space.near, np.float32(1e9)
    enter, leave = slab(ox, dx, half, enter, leave)
    enter, leave = slab(oy, dy, half, enter, leave)
    return slab(oz, dz, half, enter, leave)


@device_function
def _exit(u, d, blocks):
    """Distance, in units of u, to the far side of u's block along one axis."""
    i = np.floor(u * blocks)
    if d > np.float32(1e-9):
        return ((i + np.float32(1.0)) / blocks - u) / d
    if d < np.float32(-1e-9):
        return (i / blocks - u) / d
    return np.float32(1e9)


@device_function
def unit_cube(contracted, px, py, pz):
    """Map a point in scene units to the encoding's unit cube, [0, 1)."""
    scale, top = np.float32(0.5), np.float32(0.9999999)
    if contracted:
        scale = np.float32(0.25)
        m = max(abs(px), max(abs(py), abs(pz)))
        if m > np.float32(1.0):
            s = (np.float32(2.0) - np.float32(1.0) / m) / m
            px, py, pz = px * s, py * s, pz * s
    return (
        min(max(px * scale + np.float32(0.5), np.float32(0.0)), top),
        min(max(py * scale + np.float32(0.5), np.float32(0.0)), top),
        min(max(pz * scale + np.float32(0.5), np.float32(0.0)), top),
    )


@device_function
def march(space, o, d, t, leave, x, ts, dts, n, limit, most):
    """Append the samples of the ray from o along d (three float32 each) in occupied cells from distance t on.

    x: float32 (3, N), unit-cube coordinates; ts, dts: float32 (N,), distance and length of each sample in
    scene units. Samples n to at most limit are written; the ray ends where the density known so far makes
    an optical depth of ``most`` (NEVER: it does not). Returns (n, t, depth): t < leave if the ray ended
    early, for lack of room unless depth > most.
    """
    (ox, oy, oz), (dx, dy, dz) = o, d
    depth = np.float32(0.0)
    one, half = np.float32(1.0), np.float32(0.5)
    cells, blocks = space.cells, space.cells // COARSE
    f_cells, f_blocks = np.float32(cells), np.float32(blocks)
    scale = np.float32(0.25) if space.contracted else half
    while t < leave:
        px, py, pz = ox + t * dx, oy + t * dy, oz + t * dz
        step, inside = space.step, True
        if space.contracted:
            m = max(abs(px), max(abs(py), abs(pz)))
            if m > one:
                inside = False
                step *= m * m  # equal steps in contracted space
        ux, uy, uz = unit_cube(space.contracted, px, py, pz)
        bx, by, bz = np.int64(ux * f_blocks), np.int64(uy * f_blocks), np.int64(uz * f_blocks)
        if space.coarse[bx + blocks * (by + blocks * bz)] == 0:
            if inside:
                way = min(
                    _exit(ux, dx * scale, f_blocks),
                    min(_exit(uy, dy * scale, f_blocks), _exit(uz, dz * scale, f_blocks)),
                )
                t += max(np.ceil(way / step), one) * step  # stay on the ray's own raster
            else:
                t += step
            continue
        cx, cy, cz = np.int64(ux * f_cells), np.int64(uy * f_cells), np.int64(uz * f_cells)
        cell = cx + cells * (cy + cells * cz)
        if space.occupied[cell] != 0:
            if n >= limit or depth > most:
                return n, t, depth
            if most < NEVER:
                depth += space.density[cell] * space.step
            x[0, n], x[1, n], x[2, n] = ux, uy, uz
            ts[n], dts[n] = t, step
            n += 1
        t += step
    return n, t, depth
