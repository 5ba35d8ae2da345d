"""Depth of an image from others: colors are compared at a number of inverse depths on each pixel's ray (plane sweep,
Collins 1996), and the costs are aggregated along eight paths (semi-global matching, Hirschmueller 2008).

Costs are integers: COST is that of a difference of ``SWEEP_BOUND`` or more, and the results do not depend on the order
of sums.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.camera import (
    LENS,
    ORIGIN,
    SIZE,
    distort,
    load_camera,
    rotate_to_camera,
    within_lens,
)
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat import splat_constants as tuned

COST = 240  # 9 of them fit into the 16 bits of a sum over 3 x 3 pixels, and so do those of four paths
UNKNOWN = 1e9  # color of a pixel of which nothing is known
_UNSEEN, _NEVER = np.uint8(COST * tuned.SWEEP_UNSEEN), np.uint16(10 * COST)
_PATHS = 4  # of a pass
_ROWS = 8  # rows of pixels a task
_AHEAD = np.float32(1e-3)  # least z of a direction that another camera sees
_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@device_function
def _project_ray(camera, ray_x, ray_y, inverse, pixel, across, down):
    """Where another camera sees the points of a ray.

    camera: the other camera, see ``load_camera``, posed in the axes of the ray's camera.
    ray_x, ray_y: float32, x / z and y / z of the ray. inverse: float32 (D,), inverse depths.
    pixel: int32 (D,), written: the pixel left of and above each point, -1 where it is not seen.
    across, down: float32 (D,), written: position between that pixel's center, 0, and the next one's, 1.
    """
    width, height = np.int32(camera[SIZE]), np.int32(camera[SIZE + 1])
    right, bottom = camera[SIZE] - _F1, camera[SIZE + 1] - _F1
    for d in range(inverse.size):
        q = inverse[d]
        x, y, z = rotate_to_camera(
            camera, ray_x - q * camera[ORIGIN], ray_y - q * camera[ORIGIN + 1], _F1 - q * camera[ORIGIN + 2]
        )
        seen = z > _AHEAD
        over = _F1 / (z if seen else _F1)
        a, b = x * over, y * over
        seen = seen & within_lens(camera, a, b)
        through = distort(camera, a, b)
        u = camera[LENS] * through[0] + camera[LENS + 2] - _HALF
        v = camera[LENS + 1] * through[1] + camera[LENS + 3] - _HALF
        seen = seen & (u > -_HALF) & (v > -_HALF) & (u < right + _HALF) & (v < bottom + _HALF)
        # The outermost half of the outermost pixels has no neighbor to interpolate with.
        u, v = min(max(u if seen else _F0, _F0), right), min(max(v if seen else _F0, _F0), bottom)
        column, row = min(np.int32(u), width - 2), min(np.int32(v), height - 2)
        across[d], down[d] = u - np.float32(column), v - np.float32(row)
        pixel[d] = row * width + column if seen else np.int32(-1)


@device_function
def _compare_row(image, other, camera, row, ray_x, ray_y, inverse, scratch, differs, seen):
    """Difference of a row's pixels from another image at each inverse depth.

    image: float32 (3, H, W), the row's own, in [0, 1] or UNKNOWN. other: float32 (3, P), the other one.
    ray_x, ray_y: float32 (H, W). scratch: ``pixel``, ``across``, ``down`` of ``_project_ray``, whose arguments the
        others are.
    differs, seen: uint8 (W, D), written: the difference of the worst channel, COST at most; whether the other image
        shows the point.
    """
    red, green, blue = other[0], other[1], other[2]
    pixel, across, down = scratch
    stride, scale, most = np.int32(camera[SIZE]), np.float32(COST / tuned.SWEEP_BOUND), np.float32(COST)
    for x in range(differs.shape[0]):
        r, g, b = image[0, row, x], image[1, row, x], image[2, row, x]
        _project_ray(camera, ray_x[row, x], ray_y[row, x], inverse, pixel, across, down)
        difference, is_seen = differs[x], seen[x]
        for d in range(inverse.size):
            at = max(pixel[d], np.int32(0))
            right, below = at + np.int32(1), at + stride
            corner = below + np.int32(1)
            fu, fv = across[d], down[d]
            w0, w1, w2, w3 = (_F1 - fu) * (_F1 - fv), fu * (_F1 - fv), (_F1 - fu) * fv, fu * fv
            dr = abs(w0 * red[at] + w1 * red[right] + w2 * red[below] + w3 * red[corner] - r)
            dg = abs(w0 * green[at] + w1 * green[right] + w2 * green[below] + w3 * green[corner] - g)
            db = abs(w0 * blue[at] + w1 * blue[right] + w2 * blue[below] + w3 * blue[corner] - b)
            worst = max(dr, max(dg, db))
            known = (pixel[d] >= 0) & (worst <= _F1)
            difference[d] = np.uint8(np.int32(min(worst * scale, most))) if known else _UNSEEN
            is_seen[d] = np.uint8(known)


@device_function
def _add_means(differs, seen, middle, x, best, second):
    """Take another image into the costs of a pixel: sums over 3 x 3 pixels, least and second.

    differs, seen: uint8 (3, W, D), of three rows in turn, the pixel's own at ``middle``. x: its column.
    best, second: uint16 (D,), updated.
    """
    left, right = max(x - 1, 0), min(x + 1, differs.shape[1] - 1)
    for d in range(best.size):
        value = np.uint16(0)
        for k in range(3):
            value += np.uint16(differs[k, left, d]) + np.uint16(differs[k, x, d]) + np.uint16(differs[k, right, d])
        value = value if seen[middle, x, d] else _NEVER
        second[d] = min(second[d], max(best[d], value))
        best[d] = min(best[d], value)


@kernel
def match_costs(counter, worker, image, others, cameras, ray_x, ray_y, inverse, cost):
    """Cost of each inverse depth of each pixel: the mean difference over 3 x 3 pixels from the image that differs
    least, with a share of the second if there are ``SWEEP_SECOND_OF`` others. Tasks are runs of rows.

    image: float32 (3, H, W). others: float32 (J, 3, P), the other images, row by row. See ``_compare_row``.
    cameras: float32 (J, CAMERA), posed in the axes of the image's. ray_x, ray_y: float32 (H, W).
    inverse: float32 (D,). cost: uint8 (H, W, D), written.
    """
    height, width, steps = cost.shape
    differs, seen = np.empty((3, width, steps), np.uint8), np.empty((3, width, steps), np.uint8)
    best, second = np.empty((_ROWS, width, steps), np.uint16), np.empty((_ROWS, width, steps), np.uint16)
    scratch = np.empty(steps, np.int32), np.empty(steps, np.float32), np.empty(steps, np.float32)
    share = np.float32(tuned.SWEEP_SECOND if cameras.shape[0] >= tuned.SWEEP_SECOND_OF else 0.0)
    ninth = np.float32(1.0 / 9.0)
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        end = min(top + _ROWS, height)
        best[:], second[:] = _NEVER, _NEVER
        for j in range(cameras.shape[0]):
            camera = load_camera(cameras, j)
            for y in range(top - 1, end + 1):
                row, k = min(max(y, 0), height - 1), (y + 3) % 3
                _compare_row(image, others[j], camera, row, ray_x, ray_y, inverse, scratch, differs[k], seen[k])
                if y > top:
                    for x in range(width):
                        _add_means(differs, seen, (k + 2) % 3, x, best[y - 1 - top, x], second[y - 1 - top, x])
        for y in range(top, end):
            for x in range(width):
                for d in range(steps):
                    one, two = np.float32(best[y - top, x, d]), np.float32(second[y - top, x, d])
                    more = share * (two - one) if two < np.float32(_NEVER) else _F0
                    mean = np.uint8(np.int32((one + more) * ninth))
                    cost[y, x, d] = mean if one < np.float32(_NEVER) else _UNSEEN


@device_function
def _extend_path(own, before, floor, jump, small, ends):
    """Least cost of a path that goes on to a pixel, less the least one before; returns the least of them.

    own: uint8 (D,), the pixel's costs. before: uint16 (D,), the path's; floor: the least of these.
    jump, small: uint16, penalties of a change of any number of steps, and of one. ends: uint16 (D,), written.
    """
    steps, low = own.size, np.uint16(65535)
    for d in range(steps):
        value = min(before[d], np.uint16(floor + jump))
        value = min(value, np.uint16(before[max(d - 1, 0)] + small))
        value = min(value, np.uint16(before[min(d + 1, steps - 1)] + small))
        ends[d] = np.uint16(own[d] + value - floor)
        low = min(low, ends[d])
    return low


@kernel
def aggregate_paths(counter, worker, cost, gray, total):
    """Sum of the least costs of eight paths to each pixel. Tasks are two passes, down and up, of four paths each.

    cost: uint8 (H, W, D). gray: float32 (H, W), in [0, 1]: where it changes, depth may.
    total: uint16 (2, H, W, D), written: the sum of each pass.
    """
    height, width, steps = cost.shape
    small, large = np.uint16(COST * tuned.SWEEP_SMALL), np.float32(COST * tuned.SWEEP_LARGE)
    # Costs of the paths to the pixels of this row and of the last one; their least.
    ends, least = np.empty((2, _PATHS, width, steps), np.uint16), np.empty((2, _PATHS, width), np.uint16)
    nothing = np.zeros(steps, np.uint16)
    while True:
        task = fetch_add(counter, 1)
        if task >= 2:
            return
        way = 1 - 2 * task
        for line in range(height):
            y, now = line if task == 0 else height - 1 - line, line % 2
            for place in range(width):
                x = place if task == 0 else width - 1 - place
                for path in range(_PATHS):
                    # From beside, and from three pixels of the last row.
                    from_x = x - way if path == 0 else x + (path - 2) * way
                    from_y, of = (y, now) if path == 0 else (y - way, 1 - now)
                    before, floor, jump = nothing, np.uint16(0), np.uint16(0)
                    if from_x >= 0 and from_x < width and from_y >= 0 and from_y < height:
                        before, floor = ends[of, path, from_x], least[of, path, from_x]
                        edge = np.float32(tuned.SWEEP_EDGE) * abs(gray[y, x] - gray[from_y, from_x])
                        jump = np.uint16(np.int32(large / (_F1 + edge)))
                    least[now, path, x] = _extend_path(cost[y, x], before, floor, jump, small, ends[now, path, x])
                for d in range(steps):
                    total[task, y, x, d] = (ends[now, 0, x, d] + ends[now, 1, x, d]) + (
                        ends[now, 2, x, d] + ends[now, 3, x, d]
                    )


@kernel
def choose_depths(counter, worker, total, inverse, found):
    """The inverse depth of least cost, interpolated by a parabola. Tasks are runs of rows.

    total: uint16 (2, H, W, D). inverse: float32 (D,), evenly spaced, ascending.
    found: float32 (H, W), written; 0 where no other depth costs ``SWEEP_DISTINCT`` more.
    """
    _, height, width, steps = total.shape
    spacing, distinct = inverse[1] - inverse[0], np.int64(8 * COST * tuned.SWEEP_DISTINCT)
    sums = np.empty(steps, np.int32)
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                least, best = np.int32(1 << 30), 0
                for d in range(steps):
                    sums[d] = np.int32(total[0, y, x, d]) + np.int32(total[1, y, x, d])
                    least = min(least, sums[d])
                while sums[best] > least:
                    best += 1
                rival = np.int32(1 << 30)
                for d in range(steps):
                    rival = min(rival, sums[d] if abs(d - best) > 2 else np.int32(1 << 30))
                found[y, x] = _F0
                if rival - least < distinct:
                    continue
                middle = min(max(best, 1), steps - 2)
                a, b, c = sums[middle - 1], sums[middle], sums[middle + 1]
                bend = a - 2 * b + c
                shift = _HALF * np.float32(a - c) / np.float32(bend) if bend > 0 else _F0
                found[y, x] = inverse[middle] + min(max(shift, -_F1), _F1) * spacing
