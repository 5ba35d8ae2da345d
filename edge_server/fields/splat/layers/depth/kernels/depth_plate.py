"""The passes over depth images that make a depth plate: remember, take medians, fit planes, fill small holes.

Depth is kept as its inverse, 1 / m; 0 where nothing is known.
"""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned

_ROWS = 8  # rows of pixels a task
_F0, _F1 = np.float32(0.0), np.float32(1.0)
_FARTHEST_M = np.float32(1e6)  # no sensor measures farther: a larger number is none


@kernel
def remember_depths(depth, foreground, samples, count):
    """Add an image of depth to the last ones of each pixel.

    depth: float32 (H, W), meters; what is not a positive finite number was not measured.
    foreground: bool (H, W), pixels that do not show the plate.
    samples: float32 (H, W, KEPT), a ring of inverse depths. count: int32 (H, W), depths ever taken in.
    """
    height, width, kept = samples.shape
    for y in range(height):
        for x in range(width):
            z = depth[y, x]
            if (z > _F0) & (z < _FARTHEST_M) & (not foreground[y, x]):
                samples[y, x, count[y, x] % kept] = _F1 / z
                count[y, x] += 1


@device_function
def insert_sorted(ranked, count, value):
    """Put a value in its place among the first ``count`` of ``ranked``, which are sorted."""
    while count > 0 and ranked[count - 1] > value:
        ranked[count] = ranked[count - 1]
        count -= 1
    ranked[count] = value


@device_function
def pixel_median(samples, count, y, x, ranked):
    """The median of a pixel's depths, 1 / m; 0 if it has too few, or many of them are not alike. ranked: float32
    (KEPT,), scratch."""
    n = min(count[y, x], samples.shape[2])
    if n < tuned.LEAST:
        return _F0
    for k in range(n):
        insert_sorted(ranked, k, samples[y, x, k])
    median = np.float32(0.5) * (ranked[(n - 1) // 2] + ranked[n // 2])
    near = 0
    for k in range(n):
        near += np.int32(abs(ranked[k] - median) < np.float32(tuned.STEADY))
    return median if 3 * near >= 2 * n else _F0


@kernel
def find_medians(counter, worker, samples, count, inverse):
    """The median of each pixel's depths, see ``pixel_median``. Tasks are runs of rows.

    samples, count: see ``remember_depths``. inverse: float32 (H, W), written.
    """
    height, width, kept = samples.shape
    ranked = np.empty(kept, np.float32)
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                inverse[y, x] = pixel_median(samples, count, y, x, ranked)


@device_function
def _color_distance(image, y, x, j, i):
    """Sum of the channels' differences between two pixels."""
    return (
        abs(image[j, i, 0] - image[y, x, 0])
        + abs(image[j, i, 1] - image[y, x, 1])
        + abs(image[j, i, 2] - image[y, x, 2])
    )


@device_function
def _local_median(inverse, y, x, near):
    """Median of the known pixels among 3 x 3, and their number. near: float32 (9,), scratch."""
    height, width = inverse.shape
    n = 0
    for j in range(max(y - 1, 0), min(y + 2, height)):
        for i in range(max(x - 1, 0), min(x + 2, width)):
            if inverse[j, i] > _F0:
                insert_sorted(near, n, inverse[j, i])
                n += 1
    return np.float32(0.5) * (near[(n - 1) // 2] + near[n // 2]), n


@kernel
def fit_planes(counter, worker, inverse, image, nearness, noise, plane, slope):
    """Give each known pixel the plane that fits the inverse depths around it best, of those that lie on it: weighted
    least squares, reweighted by the distance to the plane (Cauchy). Tasks are runs of rows.

    inverse: float32 (H, W). image: float32 (H, W, 3), steps of 255: neighbors of another color count less.
    nearness: float32 (2 RADIUS + 1, 2 RADIUS + 1), weights of the window. noise: 1 / m, NOISE of the
        constants of depth.
    plane: float32 (H, W), written: inverse depth. slope: float32 (H, W, 2), written: its change a pixel to the right
        and down.
    """
    height, width = inverse.shape
    radius, near = tuned.RADIUS, np.empty(9, np.float32)
    noise, color = np.float32(noise), np.float32(1.0 / tuned.SMOOTH_COLOR)
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                plane[y, x], slope[y, x, 0], slope[y, x, 1] = _F0, _F0, _F0
                own = inverse[y, x]
                if own <= _F0:
                    continue
                # One pixel alone may be far off, but the median of few neighbors says little.
                a, n = _local_median(inverse, y, x, near)
                if n < tuned.LONE and abs(a - own) > np.float32(tuned.LONE_NOISES) * noise:
                    a = own
                b, c = _F0, _F0
                for r in range(tuned.ROUNDS):
                    scale = _F1 / (noise * np.float32(2.0 if r == 0 else 1.0))
                    s0, s1, s2, s11, s12, s22, t0, t1, t2 = _F0, _F0, _F0, _F0, _F0, _F0, _F0, _F0, _F0
                    for j in range(max(y - radius, 0), min(y + radius + 1, height)):
                        dy = np.float32(j - y)
                        for i in range(max(x - radius, 0), min(x + radius + 1, width)):
                            dx, q = np.float32(i - x), inverse[j, i]
                            e = (q - (a + b * dx + c * dy)) * scale
                            far = color * _color_distance(image, y, x, j, i)
                            w = nearness[j - y + radius, i - x + radius] / ((_F1 + e * e) * (_F1 + far * far))
                            use = (q > _F0) & (abs(e) <= np.float32(tuned.OUTLIER))
                            w = w if use else _F0
                            s0 += w
                            s1 += w * dx
                            s2 += w * dy
                            s11 += w * dx * dx
                            s12 += w * dx * dy
                            s22 += w * dy * dy
                            t0 += w * q
                            t1 += w * dx * q
                            t2 += w * dy * q
                    if s0 < np.float32(tuned.LEAST_WEIGHT):
                        break
                    mx, my = s1 / s0, s2 / s0
                    over = np.float32(tuned.LEVEL) * s0  # of a window on one line, no slope across
                    xx, xy, yy = s11 + over - s1 * mx, s12 - s1 * my, s22 + over - s2 * my
                    qx, qy = t1 - mx * t0, t2 - my * t0
                    det = xx * yy - xy * xy
                    b, c = (yy * qx - xy * qy) / det, (xx * qy - xy * qx) / det
                    a = t0 / s0 - b * mx - c * my
                if a > _F0:
                    plane[y, x], slope[y, x, 0], slope[y, x, 1] = a, b, c


@kernel
def fill_holes(counter, worker, inverse, slope, image, filled, filled_slope):
    """Give pixels without depth, beside some with it, the plane of the neighbor that is most alike in color and near.
    Tasks are runs of rows.

    inverse, slope: see ``fit_planes``. image: float32 (H, W, 3), steps of 255.
    filled: float32 (H, W), filled_slope: float32 (H, W, 2): written.
    """
    height, width = inverse.shape
    radius = tuned.HOLE_PX
    while True:
        top = fetch_add(counter, 1) * _ROWS
        if top >= height:
            return
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                filled[y, x] = inverse[y, x]
                filled_slope[y, x, 0], filled_slope[y, x, 1] = slope[y, x, 0], slope[y, x, 1]
                if inverse[y, x] > _F0:
                    continue
                least = np.float32(tuned.HOLE_MOST)
                for j in range(max(y - radius, 0), min(y + radius + 1, height)):
                    for i in range(max(x - radius, 0), min(x + radius + 1, width)):
                        if inverse[j, i] <= _F0:
                            continue
                        dx, dy = np.float32(x - i), np.float32(y - j)
                        far = _color_distance(image, y, x, j, i) / np.float32(3.0 * tuned.HOLE_COLOR)
                        far += np.float32(tuned.HOLE_NEAR) * np.sqrt(dx * dx + dy * dy)
                        value = inverse[j, i] + slope[j, i, 0] * dx + slope[j, i, 1] * dy
                        if (far < least) & (value > np.float32(tuned.HOLE_LEAST) * inverse[j, i]):
                            least, filled[y, x] = far, value
                            filled_slope[y, x, 0], filled_slope[y, x, 1] = slope[j, i, 0], slope[j, i, 1]
