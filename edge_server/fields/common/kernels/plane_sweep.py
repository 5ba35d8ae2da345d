"""Where surfaces are likely before anything is learned: cells whose color the cameras agree on, and for each
pixel the best cell on its ray (plane sweep by votes, after Seitz and Dyer's voxel coloring)."""

from __future__ import annotations

import numpy as np

from edge_server.fields import field_constants as tuned
from edge_server.fields.common.kernels.camera import LENS, NEAR, ORIGIN, distort, load_camera, within_lens
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.rays import origin_of, pixel_direction
from edge_server.fields.common.kernels.simd import fetch_add

NOT_SEEN = -2.0
# Flags of a pixel. Added up over all views, the first stays below the second.
SEES, UNMARKED = 1, 256
_NO_COLOR = 1e3  # times the number of the view: far from every color, and from one another
_BYTE = np.float32(1.0 / 255.0)

_F0, _F1 = np.float32(0.0), np.float32(1.0)


@device_function
def _spread(u):
    """A coordinate of contracted space [-2, 2] whose largest is m -> factor to scene units."""
    return _F1 / ((np.float32(2.0) - u) * u) if u > _F1 else _F1


@device_function
def _pixels_of_row(cam, first, width, height, nowhere, row, pixels):
    """Which pixel shows each cell of a row: pixels, int32 (cells,), receives its number, or ``nowhere``.

    cam: as ``load_camera`` returns it. first: the picture's first pixel. row: float32 (3, cells), the cells'
        centers.
    """
    for k in range(pixels.size):
        x, y, z = row[0, k] - cam[ORIGIN], row[1, k] - cam[ORIGIN + 1], row[2, k] - cam[ORIGIN + 2]
        depth = cam[6] * x + cam[7] * y + cam[8] * z
        over = _F1 / (depth if depth > cam[NEAR] else _F1)
        a, b = (cam[0] * x + cam[1] * y + cam[2] * z) * over, (cam[3] * x + cam[4] * y + cam[5] * z) * over
        sees = (depth > cam[NEAR]) & within_lens(cam, a, b)
        through = distort(cam, a, b)
        px, py = cam[LENS] * through[0] + cam[LENS + 2], cam[LENS + 1] * through[1] + cam[LENS + 3]
        sees = sees & (px >= _F0) & (py >= _F0) & (px < width) & (py < height)
        column, line = np.int32(px if sees else _F0), np.int32(py if sees else _F0)
        pixels[k] = first + line * width + column if sees else nowhere


@device_function
def _hidden_cells(cams, size, first, flags, nowhere, row, pixels, tally, hidden):
    """Find the pixels that show each cell of a row, and the cells that are hidden: those that most of the
    cameras seeing them see unmarked. Returns whether all are hidden; ``pixels`` is then filled only in part.

    flags: int32 (P + 1,), one for each pixel: ``SEES``, ``SEES + UNMARKED``, or 0; number P is ``nowhere``,
        with 0. Shape (0,): no cell is hidden.
    row: float32 (3, cells). tally: int32 (cells,), scratch.
    pixels: int32 (SWEEP_VIEWS, cells) and hidden: bool (cells,), receive the results.
    Cells are looked at side by side, since nearly all are hidden: few of many thousands need a closer look.
    """
    total, cells = cams.shape[0], hidden.size
    for k in range(cells):
        tally[k] = 0
    for v in range(total):
        width, height, seen = np.int32(size[v, 0]), np.int32(size[v, 1]), pixels[v]
        _pixels_of_row(load_camera(cams, v), np.int32(first[v]), width, height, np.int32(nowhere), row, seen)
        if flags.size == 0:
            continue
        few = 0
        for k in range(cells):
            tally[k] += flags[np.int64(seen[k])]
        if 2 * v < total:
            continue
        for k in range(cells):
            few += np.int32(2 * (tally[k] // UNMARKED) <= total)
        if few == 0:
            return True
    for k in range(cells):
        hidden[k] = 2 * (tally[k] // UNMARKED) > tally[k] % UNMARKED
    return False


@kernel
def score_cells(counter, worker, cams, views, blurred, flags, plain, tolerance, contracted, cells, min_views, scores):
    """How well the cameras agree on the color of each cell. Tasks are layers along z.

    cams: float32 rows of at most SWEEP_VIEWS cameras; views: ``rays.Views`` of the same. Pixels of weight 0 do
        not vote. blurred: uint8 (pixels, 3 or 4), the pictures as sharp as the cells.
    flags: see ``_hidden_cells``; (0,): all cells are scored.
    plain: float32 (3,), color of an empty background; (0,): there is none.
    tolerance: float32, between agreeing colors, summed over channels, in [0, 3].
    scores: float32 (cells^3,), x fastest, receives up to 1; NOT_SEEN where fewer than min_views see the cell,
        where it is hidden, or where background shows.
    """
    total, half = cams.shape[0], np.float32(2.0) if contracted else _F1
    colors = np.empty((3, tuned.SWEEP_VIEWS), np.float32)
    red, green, blue = colors[0], colors[1], colors[2]
    places, pixels = np.empty((3, cells), np.float32), np.empty((tuned.SWEEP_VIEWS, cells), np.int32)
    tally, hidden = np.empty(cells, np.int32), np.empty(cells, np.bool_)
    sizes, firsts, weight, nowhere = views.size, views.first, views.weight, blurred.shape[0]
    size = np.float32(2.0) * half / np.float32(cells)
    while True:
        layer = fetch_add(counter, 1)
        if layer >= cells:
            return
        for iy in range(cells):
            for ix in range(cells):
                x = (np.float32(ix) + np.float32(0.5)) * size - half
                y = (np.float32(iy) + np.float32(0.5)) * size - half
                z = (np.float32(layer) + np.float32(0.5)) * size - half
                s = _spread(max(abs(x), max(abs(y), abs(z)))) if contracted else _F1
                places[0, ix], places[1, ix], places[2, ix] = x * s, y * s, z * s
            nothing = _hidden_cells(cams, sizes, firsts, flags, nowhere, places, pixels, tally, hidden)
            for ix in range(cells):
                at = ix + cells * (iy + cells * layer)
                scores[at] = np.float32(NOT_SEEN)
                if nothing or hidden[ix]:
                    continue
                for k in range(tuned.SWEEP_VIEWS):
                    red[k] = green[k] = blue[k] = np.float32(_NO_COLOR * (k + 1))
                n, empty = 0, 0
                for v in range(total):
                    pixel = np.int64(pixels[v, ix])
                    if pixel == nowhere or (weight.size > 0 and weight[pixel] <= _F0):
                        continue
                    r = np.float32(blurred[pixel, 0]) * _BYTE
                    g = np.float32(blurred[pixel, 1]) * _BYTE
                    b = np.float32(blurred[pixel, 2]) * _BYTE
                    red[n], green[n], blue[n] = r, g, b
                    if blurred.shape[1] == 4:
                        empty += 1 if blurred[pixel, 3] < tuned.EMPTY_ALPHA else 0
                    elif plain.size > 0:
                        away = abs(r - plain[0]) + abs(g - plain[1]) + abs(b - plain[2])
                        empty += 1 if away < np.float32(tuned.EMPTY_COLOR) else 0
                    n += 1
                    if empty >= tuned.EMPTY_VIEWS:
                        break
                if n < min_views or n == 0 or empty >= min(tuned.EMPTY_VIEWS, n):
                    continue
                best = 0
                for j in range(n):
                    agree = 0
                    r, g, b = red[j], green[j], blue[j]
                    for k in range(tuned.SWEEP_VIEWS):
                        agree += np.int32(abs(r - red[k]) + abs(g - green[k]) + abs(b - blue[k]) < tolerance)
                    best = max(best, agree)
                scores[at] = np.float32(best - 1) / np.float32(n + 1)


@kernel
def sweep_rays(counter, worker, views, view_of, pixels, near, middle, contracted, cells, least, scores, distance):
    """The distance of the best cell on each ray. Tasks are runs of 256 rays.

    view_of: int64 (N,), each ray's view; pixels: int64 (N,), its pixel within that.
    near, middle: float32, scene units: the nearest distance, and the one preferred between equal scores.
    scores: float32 (cells^3,), from ``score_cells``.
    distance: float32 (N,), receives scene units; 0 where no cell scores above ``least``, float32.
    """
    half = np.float32(2.0) if contracted else _F1
    size = np.float32(2.0) * half / np.float32(cells)
    horizon = np.float32(tuned.HORIZON) if contracted else _F1
    scale = np.float32(cells) / (np.float32(2.0) * half)
    while True:
        base = fetch_add(counter, 1) * 256
        if base >= pixels.size:
            return
        for n in range(base, min(base + 256, pixels.size)):
            v = view_of[n]
            width = views.size[v, 0]
            dx, dy, dz = pixel_direction(
                views.lens[v],
                views.rotation[v],
                np.float64(pixels[n] % width) + 0.5,
                np.float64(pixels[n] // width) + 0.5,
            )
            ox, oy, oz = origin_of(views, v)
            best, at, t = least, _F0, max(near, size)
            while t < np.float32(2.0) * horizon + middle:
                x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
                m = max(abs(x), max(abs(y), abs(z)))
                step = np.float32(0.5) * size
                if m < horizon:
                    s = _F1
                    if contracted and m > _F1:
                        s = (np.float32(2.0) - _F1 / m) / m
                        step *= m * m
                    ix = min(np.int64((x * s + half) * scale), cells - 1)
                    iy = min(np.int64((y * s + half) * scale), cells - 1)
                    iz = min(np.int64((z * s + half) * scale), cells - 1)
                    score = scores[ix + cells * (iy + cells * iz)]
                    if score > best:  # only then: what is subtracted is never negative
                        score -= np.float32(tuned.SWEEP_MIDDLE) * abs(np.log(t / middle))
                        if score > best:
                            best, at = score, t
                t += step
            distance[n] = at
