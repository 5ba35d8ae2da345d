"""Render rays of a camera front to back, a few samples at a time, until each ray is opaque or has left."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.mlp import PADDING
from edge_server.fields.common.kernels.radiance_model import implements, query_color, query_density, sample_rays
from edge_server.fields.common.kernels.rays import NEVER, interval, march, pixel_direction
from edge_server.fields.common.kernels.simd import exp32, fetch_add, is_finite
from edge_server.fields.common.kernels.volume_rendering import activate, add_harmonics
from edge_server.fields.field_constants import OPAQUE_DEPTH

TILE = 256  # rays a task
ROUND = 8  # samples a ray gets before the opaque ones are dropped
BATCH = TILE * ROUND  # samples that the network evaluates at a time
ROW = BATCH + PADDING  # of which BATCH are used

_F0, _F1 = np.float32(0.0), np.float32(1.0)


@implements(sample_rays, "sampling", there=False)
def _march(encoding, space, o, travel, active, count, x, line, first):
    n = np.int64(0)  # typed: numba compiles callees anew for a literal
    for k in range(count):
        r = active[k]
        d, t, leave = (travel[r, 0], travel[r, 1], travel[r, 2]), travel[r, 3], travel[r, 4]
        n, travel[r, 3], _ = march(space, o, d, t, leave, x, line[0], line[1], n, n + ROUND, NEVER)
        first[k + 1] = n
    return count


@kernel
def render_tiles(counter, worker, camera, pixels, space, model, sh_degree, background, scratch, out):
    """Render image points; tasks are runs of TILE of them.

    camera: lens, float64 (8,); rotation, float64 (3, 3), camera to world; origin, float64 (3,), scene units.
    model: encoding, number of its levels in use, network.
    pixels: float64 (N, 2), image points. background: float32 (3,).
    scratch: float32 (W, units, ROW), (W, 3, ROW) and (W, 3, ROW), activations, points and lines.
    out: color, float32 (N, 3) in [0, 1], depth (scene units) and opacity in [0, 1]: float32 (N,); all written.
    """
    (lens, rotation, origin), (encoding, levels, net), (color, depth, opacity) = camera, model, out
    acts, x, line = scratch[0][worker], scratch[1][worker], scratch[2][worker]
    dts, shaded = line[1], acts[acts.shape[0] - net.widths[-1] :]
    travel = np.empty((TILE, 6), np.float32)  # direction, distance reached, distance of leaving, optical depth
    first = np.empty(TILE + 1, np.int64)
    active = np.empty(TILE, np.int64)
    o = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    while True:
        base = fetch_add(counter, 1) * TILE
        if base >= pixels.shape[0]:
            return
        rays = min(TILE, pixels.shape[0] - base)
        count = 0
        for r in range(rays):
            d = pixel_direction(lens, rotation, pixels[base + r, 0], pixels[base + r, 1])
            enter, leave = interval(space, o, d)
            travel[r, 0], travel[r, 1], travel[r, 2] = d
            travel[r, 3], travel[r, 4], travel[r, 5] = enter + np.float32(0.5) * space.step, leave, _F0
            color[base + r] = _F0
            depth[base + r] = opacity[base + r] = _F0
            if leave > enter:
                active[count] = r
                count += 1
        while count > 0:
            first[0] = start = np.int64(0)
            some = sample_rays(encoding, space, o, travel, active, count, x, line, first)
            n = first[some]
            query_density(encoding, levels, net, x, start, n, acts)
            query_color(encoding, levels, net, x, start, n, acts)
            if sh_degree > 0:
                for k in range(some):
                    r = active[k]
                    add_harmonics(shaded, sh_degree, first[k], first[k + 1], travel[r, 0], travel[r, 1], travel[r, 2])
            activate(shaded, start, n)
            left = 0
            for k in range(some):
                r = active[k]
                pixel = base + r
                through = exp32(-travel[r, 5])
                for s in range(first[k], first[k + 1]):
                    travel[r, 5] += shaded[0, s] * dts[s]
                    after = exp32(-travel[r, 5])
                    w = through - after
                    color[pixel, 0] += w * shaded[1, s]
                    color[pixel, 1] += w * shaded[2, s]
                    color[pixel, 2] += w * shaded[3, s]
                    depth[pixel] += w * line[0, s]
                    opacity[pixel] += w
                    through = after
                    if travel[r, 5] > np.float32(OPAQUE_DEPTH):
                        break
                if travel[r, 5] <= np.float32(OPAQUE_DEPTH) and travel[r, 3] < travel[r, 4]:
                    active[left] = r
                    left += 1
            for k in range(some, count):
                active[left] = active[k]
                left += 1
            count = left
        for r in range(rays):
            pixel = base + r
            through = max(_F1 - opacity[pixel], _F0)
            # Empty rays have no depth; dividing by what opacity there is keeps thin surfaces in place.
            if opacity[pixel] > np.float32(1e-3):
                depth[pixel] /= opacity[pixel]
            else:
                depth[pixel] = _F0
            for c in range(3):
                value = color[pixel, c] + through * background[c]
                color[pixel, c] = min(max(value, _F0), _F1) if is_finite(value) else background[c]
            if not is_finite(depth[pixel]) or not is_finite(opacity[pixel]):
                depth[pixel] = opacity[pixel] = _F0
            # Only now: above, the sum itself is what colors and depth were weighted with. Rounding takes it past 1.
            opacity[pixel] = min(max(opacity[pixel], _F0), _F1)
