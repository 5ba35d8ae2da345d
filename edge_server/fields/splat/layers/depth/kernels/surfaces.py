"""Draws depth plates from places where no camera is: each as a mesh, then of each pixel the surface that the cameras
agree on and its color.

Lengths are meters from a common center, in float32. Cameras are rows of numbers in them (``common.camera_rows``).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import LENS, ORIGIN, distort, load_camera, rotate_to_camera, within_lens
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd import fetch_add
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned

_ROWS = 8  # rows of pixels a task
_F0, _F1, _HALF = np.float32(0.0), np.float32(1.0), np.float32(0.5)


class Meshes(NamedTuple):
    """The depth plates of N cameras, the pixels of all in one list.

    first: int64 (N + 1,), where a camera's pixels begin. size: int64 (N, 2), width and height.
    cams: float32 (N, CAMERA).
    points: float32 (P, 3), where the centers of pixels lie. depth: float32 (P,), along the axis; 0 unknown.
    normal: float32 (P, 3), unit, towards the camera.
    color: float32 (P, 3) in [0, 1].
    joined: bool (P,), whether a pixel, its right, its lower and its lower right neighbor lie on one surface.
    trust: float32 (P,), 1 within a surface, less beside its edges, 0 without depth.
    """

    first: NDArray[np.int64]
    size: NDArray[np.int64]
    cams: NDArray[np.float32]
    points: NDArray[np.float32]
    depth: NDArray[np.float32]
    normal: NDArray[np.float32]
    color: NDArray[np.float32]
    joined: NDArray[np.bool_]
    trust: NDArray[np.float32]


@device_function
def _draw_triangle(u, v, q, a, b, c, flipped, out):
    """Draw a triangle of vertices a, b, c into the image of the largest inverse depth so far, unless it faces away
    (clockwise instead of counterclockwise, or the reverse if ``flipped``) or is seen at too grazing an angle."""
    height, width = out.shape
    ax, ay, bx, by = u[b] - u[a], v[b] - v[a], u[c] - u[a], v[c] - v[a]
    area = ax * by - ay * bx
    facing = -area if flipped else area
    left, right = min(u[a], min(u[b], u[c])), max(u[a], max(u[b], u[c]))
    top, bottom = min(v[a], min(v[b], v[c])), max(v[a], max(v[b], v[c]))
    longest = max(ax * ax + ay * ay, bx * bx + by * by)
    if (facing <= np.float32(1e-4)) | (longest > np.float32(tuned.STRETCH) * facing):
        return
    if (right < _F0) | (bottom < _F0) | (left > width - 1) | (top > height - 1):
        return
    over, edge = _F1 / area, np.float32(1e-3)  # neighbors overlap a little, so that no pixel falls between them
    for y in range(max(np.int64(np.ceil(top)), 0), min(np.int64(np.floor(bottom)) + 1, height)):
        for x in range(max(np.int64(np.ceil(left)), 0), min(np.int64(np.floor(right)) + 1, width)):
            dx, dy = np.float32(x) - u[a], np.float32(y) - v[a]
            s, t = (dx * by - dy * bx) * over, (ax * dy - ay * dx) * over
            if (s >= -edge) & (t >= -edge) & (s + t <= _F1 + edge):
                out[y, x] = max(out[y, x], q[a] + s * (q[b] - q[a]) + t * (q[c] - q[a]))


@kernel
def draw_meshes(counter, worker, meshes, targets, inverse):
    """Draw each camera's mesh from each target. Tasks are pairs of target and camera.

    meshes: ``Meshes``. targets: float32 (B, CAMERA), without distortion.
    inverse: float32 (B, N, H, W), written: 1 / depth of the nearest surface; 0 where there is none.
    """
    count = meshes.size.shape[0]
    while True:
        task = fetch_add(counter, 1)
        if task >= targets.shape[0] * count:
            return
        b, k = task // count, task % count
        out, cam = inverse[b, k], load_camera(targets, b)
        out[:] = _F0
        width, height, first = meshes.size[k, 0], meshes.size[k, 1], meshes.first[k]
        u, v = np.empty(width * height, np.float32), np.empty(width * height, np.float32)
        q = np.empty(width * height, np.float32)
        for i in range(width * height):
            p = meshes.points[first + i]
            x, y, z = rotate_to_camera(cam, p[0] - cam[ORIGIN], p[1] - cam[ORIGIN + 1], p[2] - cam[ORIGIN + 2])
            seen = (meshes.depth[first + i] > _F0) & (z > np.float32(tuned.NEAREST_M))
            q[i] = _F1 / z if seen else _F0
            u[i] = cam[LENS] * x * q[i] + cam[LENS + 2] - _HALF
            v[i] = cam[LENS + 1] * y * q[i] + cam[LENS + 3] - _HALF
        for row in range(height - 1):
            for i in range(row * width, row * width + width - 1):
                if meshes.joined[first + i] and min(min(q[i], q[i + 1]), min(q[i + width], q[i + width + 1])) > _F0:
                    _draw_triangle(u, v, q, i, i + 1, i + width, False, out)
                    _draw_triangle(u, v, q, i + width + 1, i + 1, i + width, True, out)


@device_function
def _look(meshes, k, x, y, z):
    """What camera k says about a point of a surface: how far its depth agrees, how far it sees through the point, color
    and normal (both times the agreement), vector from the camera to the point."""
    cam, width, height = load_camera(meshes.cams, k), meshes.size[k, 0], meshes.size[k, 1]
    tx, ty, tz = x - cam[ORIGIN], y - cam[ORIGIN + 1], z - cam[ORIGIN + 2]
    a, b, d = rotate_to_camera(cam, tx, ty, tz)
    over = _F1 / (d if d > np.float32(tuned.NEAREST_M) else _F1)
    through_lens = distort(cam, a * over, b * over)
    u, v = cam[LENS] * through_lens[0] + cam[LENS + 2], cam[LENS + 1] * through_lens[1] + cam[LENS + 3]
    agree, through, r, g, bl, nx, ny, nz = _F0, _F0, _F0, _F0, _F0, _F0, _F0, _F0
    inside = within_lens(cam, a * over, b * over) & (u >= _F0) & (v >= _F0) & (u < width) & (v < height)
    if inside & (d > np.float32(tuned.NEAREST_M)):
        u = min(max(u - _HALF, _F0), np.float32(width) - np.float32(1.001))
        v = min(max(v - _HALF, _F0), np.float32(height) - np.float32(1.001))
        i, j = np.int64(u), np.int64(v)
        fu, fv = u - np.float32(i), v - np.float32(j)
        scale = _F1 / (np.float32(tuned.AGREE) * d)
        for n in range(4):
            p = meshes.first[k] + (j + n // 2) * width + i + n % 2
            share = (fu if n % 2 else _F1 - fu) * (fv if n // 2 else _F1 - fv)
            depth = meshes.depth[p]
            e = (depth - d) * scale
            known = depth > _F0
            through += share if known & (e > np.float32(tuned.THROUGH)) else _F0
            w = share * meshes.trust[p] / (_F1 + e * e * e * e) if known else _F0
            agree += w
            r += w * meshes.color[p, 0]
            g += w * meshes.color[p, 1]
            bl += w * meshes.color[p, 2]
            nx += w * meshes.normal[p, 0]
            ny += w * meshes.normal[p, 1]
            nz += w * meshes.normal[p, 2]
    return agree, through, r, g, bl, nx, ny, nz, tx, ty, tz


@kernel
def shade_surfaces(counter, worker, meshes, targets, inverse, color, agreement):
    """Of the surfaces that meshes put at a pixel, take the nearest one that cameras agree on, and no more of them see
    through it; of its color the mean over the cameras, those before others that see it finely, squarely and from a
    direction like the target's. Tasks are runs of rows.

    meshes, targets, inverse: see ``draw_meshes``.
    color: float32 (B, H, W, 3), written. agreement: float32 (B, H, W) in [0, 1], written: 0 where no camera says
        anything.
    """
    total, count, height, width = inverse.shape
    tried, runs = np.empty(count, np.bool_), -(-height // _ROWS)
    while True:
        task = fetch_add(counter, 1)
        if task >= total * runs:
            return
        t, top = task // runs, (task % runs) * _ROWS
        cam = load_camera(targets, t)
        for y in range(top, min(top + _ROWS, height)):
            for x in range(width):
                color[t, y, x, 0], color[t, y, x, 1], color[t, y, x, 2] = _F0, _F0, _F0
                sure, found = _F0, False
                for k in range(count):
                    tried[k] = inverse[t, k, y, x] <= _F0
                while not found:
                    front = _F0
                    for k in range(count):
                        front = max(front, _F0 if tried[k] else inverse[t, k, y, x])
                    if front <= _F0:
                        break
                    mean, same = _F0, _F0
                    for k in range(count):
                        q = inverse[t, k, y, x]
                        if (q > _F0) & (abs(q - front) < np.float32(tuned.SAME_SURFACE * tuned.AGREE) * front):
                            tried[k] = True
                            mean += q
                            same += _F1
                    z = same / mean
                    a = (np.float32(x) + _HALF - cam[LENS + 2]) / cam[LENS] * z
                    b = (np.float32(y) + _HALF - cam[LENS + 3]) / cam[LENS + 1] * z
                    px, py = cam[0] * a + cam[3] * b + cam[6] * z, cam[1] * a + cam[4] * b + cam[7] * z
                    pz = cam[2] * a + cam[5] * b + cam[8] * z
                    away = np.sqrt(px * px + py * py + pz * pz)
                    weights, r, g, bl, agree, through = _F0, _F0, _F0, _F0, _F0, _F0
                    for k in range(count):
                        w, beyond, cr, cg, cb, nx, ny, nz, tx, ty, tz = _look(
                            meshes, k, px + cam[ORIGIN], py + cam[ORIGIN + 1], pz + cam[ORIGIN + 2]
                        )
                        through += beyond
                        if w < np.float32(tuned.LEAST_TRUST):
                            continue
                        far2, length = tx * tx + ty * ty + tz * tz, np.sqrt(nx * nx + ny * ny + nz * nz)
                        far = np.sqrt(far2)
                        facing = -(nx * tx + ny * ty + nz * tz) / (far * (length + np.float32(1e-9)))
                        fine = max(facing, np.float32(tuned.LEAST_FACING)) / far2
                        along = (tx * px + ty * py + tz * pz) / (far * away)
                        better = fine * np.sqrt(fine) * np.exp(np.float32(tuned.FORWARD) * (along - _F1))
                        r += better * cr
                        g += better * cg
                        bl += better * cb
                        weights += better * w
                        agree += min(w, _F1)
                    if weights <= _F0:
                        continue
                    found = through <= np.float32(tuned.REJECT) * agree + np.float32(tuned.REJECT_LEAST)
                    if found or sure <= _F0:  # of surfaces that are seen through, the nearest
                        color[t, y, x, 0], color[t, y, x, 1], color[t, y, x, 2] = r / weights, g / weights, bl / weights
                        sure = np.float32(tuned.SEEN_THROUGH) * min(agree, _F1)
                        if found:
                            sure = min(np.float32(tuned.ENOUGH) * agree, _F1)
                agreement[t, y, x] = sure
