"""Rendering with samples from a proposal: all samples of a ray are placed at once."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.kernels.jit import kernel
from edge_server.fields.common.kernels.radiance_model import query_color, query_density
from edge_server.fields.common.kernels.rays import pixel_direction
from edge_server.fields.common.kernels.simd import exp32, fetch_add, is_finite
from edge_server.fields.common.kernels.volume_rendering import OPAQUE_DEPTH, activate, add_harmonics
from edge_server.fields.nerfacto.kernels.proposal import sample_ray

TILE = 256  # rays a task
SAMPLE_BATCH = 2048  # samples that the network evaluates at a time

_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


@kernel
def render_with_proposal(
    counter,
    worker,
    lens,
    rotation,
    origin,
    pixels,
    sampling,
    space,
    encoding,
    levels,
    net,
    harmonics,
    background,
    acts,
    x,
    line,
    color,
    depth,
    opacity,
):
    """Render image points: pixels, float64 (N, 2).

    Writes color, float32 (N, 3), depth in scene units and opacity, (N,). Scratch: acts, float32 (W, units,
    SAMPLE_BATCH); x and line, (W, 3, SAMPLE_BATCH).
    """
    out = acts[worker, acts.shape[1] - net.widths[-1] :]
    ts, dts = line[worker, 0], line[worker, 1]
    edges, share = np.empty((2, sampling.bins + 1), np.float32), np.empty(sampling.bins, np.int64)
    scratch = edges, np.empty((2, sampling.bins), np.int32), share
    cell, group = np.empty(sampling.bins, np.int32), np.empty(sampling.bins, np.int32)
    bins = cell, np.empty(sampling.bins, np.float32), np.empty(sampling.bins, np.float32), group
    way, first = np.empty((TILE, 3), np.float32), np.empty(TILE + 1, np.int64)
    o = np.float32(origin[0]), np.float32(origin[1]), np.float32(origin[2])
    zero = np.int64(0)
    while True:
        base = fetch_add(counter, 1) * TILE
        if base >= pixels.shape[0]:
            return
        rays, done = min(TILE, pixels.shape[0] - base), 0
        while done < rays:
            n, here = np.int64(0), 0
            first[0] = 0
            while done + here < rays and (n + 2 * sampling.samples + 1 <= SAMPLE_BATCH or here == 0):
                pixel = base + done + here
                d = pixel_direction(lens, rotation, pixels[pixel, 0], pixels[pixel, 1])
                way[here, 0], way[here, 1], way[here, 2] = d
                _, _, n = sample_ray(
                    space, encoding, sampling, o, d, _HALF, _HALF, bins, zero, scratch, n, x[worker], line[worker]
                )
                here += 1
                first[here] = n
            query_density(encoding, levels, net, x[worker], zero, n, acts[worker])
            query_color(encoding, levels, net, x[worker], zero, n, acts[worker])
            if harmonics > 1:
                for r in range(here):
                    add_harmonics(out, harmonics, first[r], first[r + 1], way[r, 0], way[r, 1], way[r, 2])
            activate(out, zero, n)
            for r in range(here):
                pixel = base + done + r
                total, through, far, red, green, blue = _F0, _F1, _F0, _F0, _F0, _F0
                for s in range(first[r], first[r + 1]):
                    total += out[0, s] * dts[s]
                    after = exp32(-total)
                    w = through - after
                    red += w * out[1, s]
                    green += w * out[2, s]
                    blue += w * out[3, s]
                    far += w * ts[s]
                    through = after
                    if total > np.float32(OPAQUE_DEPTH):
                        break
                solid = _F1 - through
                # Empty rays have no depth; dividing by what opacity there is keeps thin surfaces in place.
                far = far / solid if solid > np.float32(1e-3) else _F0
                fine = is_finite(far) and is_finite(solid)
                depth[pixel], opacity[pixel] = (far, solid) if fine else (_F0, _F0)
                color[pixel, 0] = red + through * background[0]
                color[pixel, 1] = green + through * background[1]
                color[pixel, 2] = blue + through * background[2]
                for c in range(3):
                    value = color[pixel, c]
                    color[pixel, c] = min(max(value, _F0), _F1) if is_finite(value) else background[c]
            done += here
