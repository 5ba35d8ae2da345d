"""Gauss-Newton of one view's photometric error in the displacements of the anchors, on strips of 16 pixels.

The Gaussians are composited over the camera's plate. Then, back to front, the slope of each pixel's color by
a Gaussian's place goes to the columns of its anchors, and a tile adds the Gram matrix of the columns that it
touches. An anchor has two columns, not three: its Gaussians share a direction of sight (each has its own
depth and lens), so that motion in space is a motion across it, in camera axes U = X - (x/z) Z, V = Y - (y/z)
Z. The sums of all tiles are lifted to three axes at the end.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic
from numpy.typing import NDArray

from edge_server.fields.common.kernels.camera import LENS, NEAR, lens_terms, load_camera, rotate_to_camera
from edge_server.fields.common.kernels.jit import device_function, kernel
from edge_server.fields.common.kernels.simd_vectors import (
    LANES,
    Vector,
    any_lane,
    constant,
    eight_lane_sums,
    require_contiguous,
)
from edge_server.fields.splat.kernels.composite import PIXELS, SAVED, STRIP, STRIPS, _StripBuilder
from edge_server.fields.splat.kernels.project import CONIC_A, CONIC_B, CONIC_C, MEAN_X, MEAN_Y, RED, TILE
from edge_server.fields.splat.kernels.rasterize import begin_tile, composite_strips, strip_scratch
from edge_server.fields.splat.layers.layer_constants import ATTACHED, NOISE, ROBUST
from edge_server.fields.splat.splat_constants import ALPHA_MAX, ALPHA_MIN

_COLUMN = 3 * PIXELS  # floats: red, green and blue of a tile
_ANCHOR = 2 * _COLUMN
_PRECISION = 1.0 / NOISE**2
_T, _R = 0, PIXELS  # rows of a tile's memory, see ``rasterize``
_F0, _F1 = np.float32(0.0), np.float32(1.0)
_BYTE, _SOFT = np.float32(1.0 / 255.0), np.float32(1.0 / ROBUST**2)
_I64 = ir.IntType(64)


def align_view(
    raster: Any,
    camera: NDArray[np.float32],
    places: NDArray[np.float32],
    image: NDArray[np.uint8],
    plate: NDArray[np.float32],
    weight: NDArray[np.float32],
    anchor: NDArray[np.int64],
    share: NDArray[np.float32],
    anchors: int,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float32], NDArray[np.float32]]:
    """Normal matrix (3K, 3K) and right side (3K,) of one view, see ``motion.ViewRow``; what is shown, float32
    (H, W, 3), and the Gaussians' opacity, float32 (H, W). Tiles of weight 0 show the plate alone.

    raster: ``RasterBuffers`` whose last ``project_and_bin`` had this camera.
    camera: float32 (1, CAMERA), its row.
    places: float32 (N, 3), of the projected Gaussians, scene units.
    image: uint8 (H, W, 3). plate: float32 (H, W, 3), of 255. weight: float32 (H, W), at least 0.
    anchor, share: int64 and float32 (N, 3), see ``Motion.attach``. anchors: K, how many there are.
    """
    matrix, vector = np.empty((3 * anchors, 3 * anchors)), np.empty(3 * anchors)
    shown, opacity = np.empty(image.shape, np.float32), np.empty(image.shape[:2], np.float32)
    add_view(image, plate, weight, raster.raster, camera, places, anchor, share, matrix, vector, shown, opacity)
    return matrix, vector, shown, opacity


@intrinsic
def _spread(
    typingctx: Any,
    pairs: Any,
    count: Any,
    owner: Any,
    projected: Any,
    x0: Any,
    y0: Any,
    behind: Any,
    first: Any,
    saved: Any,
    scale: Any,
    anchor: Any,
    share: Any,
    slopes: Any,
) -> Any:
    """Add a strip's slopes of color to its anchors' columns, back to front; see ``composite`` for arguments
    not here.

    behind: float32 rows of PIXELS: red, green and blue of the plate, the root of each pixel's weight.
    scale: float32 (N, 4), see ``_prepare``.
    slopes: float32, columns of the anchors, added to.
    """
    require_contiguous(pairs, owner, projected, behind, saved, scale, anchor, share, slopes)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        strip = _StripBuilder(context, builder, signature, args)
        pair_data, owners, rows, behind_data, saved_data, scales, anchors, shares, columns = (
            strip.data(n) for n in (0, 2, 3, 6, 8, 9, 10, 11, 12)
        )
        count, x0, y0, first = args[1], args[4], args[5], args[7]
        x, y = strip.pixels(x0, y0)
        *plate, root = (Vector.load(builder, strip.at(behind_data, first, PIXELS * k)) for k in range(4))
        state = strip.variables(plate)
        with cgutils.for_range(builder, count) as loop:
            n = builder.sub(builder.sub(count, _I64(1)), loop.index)
            keep = strip.at(saved_data, builder.mul(n, _I64(SAVED)))
            a = Vector.load(builder, keep)
            with builder.if_then(any_lane(builder, a.greater_equal(ALPHA_MIN))):
                i = strip.number(owners, strip.number(pair_data, n))
                row = strip.row(rows, owners, strip.number(pair_data, n))
                mx, my, qa, qb, qc, *shades = strip.columns(
                    row, MEAN_X, MEAN_Y, CONIC_A, CONIC_B, CONIC_C, RED, RED + 1, RED + 2
                )
                light = Vector.load(builder, strip.at(keep, _I64(STRIP)))
                dx, dy = x - mx, y - my
                over = [shade - back for shade, back in zip(shades, strip.get(state), strict=True)]
                strip.set(state, [b + a * o for b, o in zip(strip.get(state), over, strict=True)])
                t = (a * light * root).where(a.less(ALPHA_MAX))
                hx, hy = t * (dx * qa + dy * qb), t * (dx * qb + dy * qc)
                xu, xv, yu, yv = strip.columns(strip.at(scales, builder.mul(i, _I64(4))), 0, 1, 2, 3)
                across = (hx * xu + hy * yu, hx * xv + hy * yv)
                steps = [h * o for h in across for o in over]
                for m in range(ATTACHED):
                    at = builder.add(builder.mul(i, _I64(ATTACHED)), _I64(m))
                    part_of = Vector.broadcast(builder, builder.load(strip.at(shares, at)))
                    own = builder.mul(builder.load(strip.at(anchors, at)), _I64(_ANCHOR))
                    column = strip.at(columns, own, first)
                    for k, step in enumerate(steps):
                        place = strip.at(column, _I64(PIXELS * k))
                        (Vector.load(builder, place) + part_of * step).store(place)
        return context.get_dummy_value()

    f32, i64 = types.float32, types.int64
    kinds = (pairs, i64, owner, projected, f32, f32, behind, i64, saved, scale, anchor, share, slopes)
    return types.void(*kinds), codegen


@intrinsic
def _multiply(typingctx: Any, slopes: Any, a0: Any, a1: Any, b0: Any, b1: Any, out: Any) -> Any:
    """Products of the four columns of anchors a0, a1 with the four of b0, b1: float32 out[:16], row by
    row."""
    require_contiguous(slopes, out)

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data, out_data = (context.make_array(signature.args[n])(context, builder, args[n]).data for n in (0, 5))
        bases = [builder.gep(data, [builder.mul(n, _I64(_ANCHOR))]) for n in args[1:5]]
        left, right = (
            [builder.gep(base, [_I64(k * _COLUMN)]) for base in pair for k in range(2)]
            for pair in (bases[:2], bases[2:])
        )
        sums = [cgutils.alloca_once_value(builder, constant(0.0)) for _ in range(16)]
        with cgutils.for_range(builder, _I64(_COLUMN // LANES)) as loop:
            k = builder.mul(loop.index, _I64(LANES))
            a, b = ([Vector.load(builder, builder.gep(p, [k])) for p in side] for side in (left, right))
            for n, total in enumerate(sums):
                added = Vector(builder, builder.load(total)) + a[n // 4] * b[n % 4]
                builder.store(added.value, total)
        for h in (0, 8):
            eight = eight_lane_sums([Vector(builder, builder.load(total)) for total in sums[h : h + 8]])
            place = builder.bitcast(builder.gep(out_data, [_I64(h)]), eight.type.as_pointer())
            builder.store(eight, place).align = 4
        return context.get_dummy_value()

    i64 = types.int64
    return types.void(slopes, i64, i64, i64, i64, out), codegen


@device_function
def _prepare(cam, places, anchor, share, scale, across):
    """What the picture's slopes are multiplied by.

    scale: float32 (N, 4), written: pixels x by U and V, pixels y by U and V, for each Gaussian.
    across: float64 (K, 2, 3), written: U and V by an anchor's displacement, where its Gaussians are on
    average.
    """
    ratios, total = np.zeros((across.shape[0], 2)), np.zeros(across.shape[0])
    for i in range(places.shape[0]):
        x, y, z = rotate_to_camera(cam, places[i, 0] - cam[9], places[i, 1] - cam[10], places[i, 2] - cam[11])
        if not z > cam[NEAR]:  # not in the picture
            scale[i, 0] = scale[i, 1] = scale[i, 2] = scale[i, 3] = _F0
            continue
        _, _, tx, ty, _, _, dxx, dxy, dyy, _, _, _, _, inverse = lens_terms(cam, x, y, z)
        gx, gy = cam[LENS] * inverse, cam[LENS + 1] * inverse
        scale[i, 0], scale[i, 1], scale[i, 2], scale[i, 3] = gx * dxx, gx * dxy, gy * dxy, gy * dyy
        for m in range(ATTACHED):
            a, s = anchor[i, m], np.float64(share[i, m])
            ratios[a, 0] += s * tx
            ratios[a, 1] += s * ty
            total[a] += s
    for a in range(across.shape[0]):
        for k in range(2):
            ratio = ratios[a, k] / total[a] if total[a] > 0.0 else 0.0
            for d in range(3):
                across[a, k, d] = cam[3 * k + d] - ratio * cam[6 + d]


@device_function
def _lift(flat, flat_vector, across, matrix, vector):
    """From U and V, flat (2, 2, K + 1, K + 1) of which anchors a <= b are filled, to three axes."""
    for a in range(across.shape[0]):
        for d in range(3):
            vector[3 * a + d] = _PRECISION * (across[a, 0, d] * flat_vector[a, 0] + across[a, 1, d] * flat_vector[a, 1])
        for b in range(a, across.shape[0]):
            for d in range(3):
                u = across[a, 0, d] * flat[0, 0, a, b] + across[a, 1, d] * flat[1, 0, a, b]
                v = across[a, 0, d] * flat[0, 1, a, b] + across[a, 1, d] * flat[1, 1, a, b]
                for e in range(3):
                    value = _PRECISION * (u * across[b, 0, e] + v * across[b, 1, e])
                    matrix[3 * a + d, 3 * b + e] = value
                    matrix[3 * b + e, 3 * a + d] = value


@device_function
def _compare(s, image, weight, x0, y0, behind, rest, shown, opacity):
    """Show a composited tile, and fill the roots of its weights (last row of ``behind``) and weighted errors,
    rest (3 * PIXELS,)."""
    for k in range(PIXELS):
        x, y = x0 + k % TILE, y0 + k // TILE
        root = _F0
        if x < image.shape[1] and y < image.shape[0]:
            square = _F0
            for c in range(3):
                value = s[_R + c * PIXELS + k] + s[_T + k] * behind[c * PIXELS + k]
                shown[y, x, c] = value
                e = np.float32(image[y, x, c]) * _BYTE - value
                rest[c * PIXELS + k] = e
                square += e * e
            opacity[y, x] = _F1 - s[_T + k]
            root = np.sqrt(max(weight[y, x], _F0) / (_F1 + square * _SOFT))
        behind[3 * PIXELS + k] = root
        for c in range(3):
            rest[c * PIXELS + k] = rest[c * PIXELS + k] * root if root > _F0 else _F0


@device_function
def _heaviest(image, plate, weight, x0, y0, behind):
    """Load the plate of a tile into ``behind``; returns the largest weight."""
    heaviest = _F0
    for k in range(PIXELS):
        x, y = x0 + k % TILE, y0 + k // TILE
        inside = x < image.shape[1] and y < image.shape[0]
        if inside:
            heaviest = max(heaviest, weight[y, x])
        for c in range(3):
            behind[c * PIXELS + k] = plate[y, x, c] * _BYTE if inside else _F0
    return heaviest


@kernel
def add_view(image, plate, weight, raster, cams, places, anchor, share, matrix, vector, shown, opacity):
    """See ``align_view``."""
    height, width, anchors, lists = image.shape[0], image.shape[1], vector.size // 3, raster.lists
    for y in range(height):
        for x in range(width):
            opacity[y, x] = _F0
            for c in range(3):
                shown[y, x, c] = plate[y, x, c] * _BYTE
    scale, across = np.empty((places.shape[0], 4), np.float32), np.empty((anchors, 2, 3))
    _prepare(load_camera(cams, 0), places, anchor, share, scale, across)
    # One anchor more than there are: nobody's, for tiles with an odd number of anchors.
    flat, flat_vector = np.zeros((2, 2, anchors + 1, anchors + 1)), np.zeros((anchors, 2))
    slopes = np.zeros((anchors + 1) * _ANCHOR, np.float32)
    mark, touched = np.full(anchors, -1, np.int64), np.empty(anchors + 1, np.int64)
    s, behind = np.empty(5 * PIXELS, np.float32), np.empty(4 * PIXELS, np.float32)
    rest, products = np.zeros(_COLUMN, np.float32), np.empty(16, np.float32)
    (strip_pairs, count), composited = strip_scratch(lists), np.empty(STRIPS, np.int64)
    size = strip_pairs.shape[1] * SAVED
    store = np.empty(STRIPS * size, np.float32)
    for t in range(raster.columns * raster.rows):
        x0, y0 = TILE * (t % raster.columns), TILE * (t // raster.columns)
        some = lists.first[t] < lists.first[t + 1]
        if not some or not _heaviest(image, plate, weight, x0, y0, behind) > _F0:
            continue
        _, _, begin, end = begin_tile(raster, t, s, strip_pairs, count)
        composite_strips(raster, strip_pairs, count, x0, y0, s, store, size, SAVED, composited)
        _compare(s, image, weight, x0, y0, behind, rest, shown, opacity)
        many = 0
        for j in range(begin, end):
            i = lists.owner[lists.pair[j]]
            for m in range(ATTACHED):
                a = anchor[i, m]
                if mark[a] != t:
                    mark[a], touched[many] = t, a
                    many += 1
                    for k in range(a * _ANCHOR, (a + 1) * _ANCHOR):
                        slopes[k] = _F0
        touched[many] = anchors
        for n in range(STRIPS):
            _spread(
                strip_pairs[n],
                composited[n],
                lists.owner,
                raster.projected,
                np.float32(x0),
                np.float32(y0 + 2 * n),
                behind,
                n * STRIP,
                store[n * size : (n + 1) * size],
                scale,
                anchor,
                share,
                slopes,
            )
        for u in range(many):
            for d in range(2):
                total, at = _F0, (2 * touched[u] + d) * _COLUMN
                for k in range(_COLUMN):
                    total += slopes[at + k] * rest[k]
                flat_vector[touched[u], d] += total
        for u in range(0, many, 2):
            for v in range(u, many, 2):
                _multiply(slopes, touched[u], touched[u + 1], touched[v], touched[v + 1], products)
                for n in range(16):
                    p, q, d, e = n // 8, n // 2 % 2, n // 4 % 2, n % 2
                    if u < v or p <= q:
                        a, b = touched[u + p], touched[v + q]
                        if a > b:
                            a, b, d, e = b, a, e, d
                        flat[d, e, a, b] += products[n]
    _lift(flat, flat_vector, across, matrix, vector)
