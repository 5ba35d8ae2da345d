"""A view's normal equations against a Gauss-Newton by pixels, and against differences of rendered images."""

import numpy as np
import pytest

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.composite import ALPHA_MAX, STOP
from edge_server.fields.splat.kernels.project import ALPHA, ALPHA_MIN, CONIC_A, CONIC_B, CONIC_C, MEAN_X, MEAN_Y, RED
from edge_server.fields.splat.layers.kernels.align import NOISE, ROBUST, align_view
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, binned, random_params

LENS = Pinhole(29, 21, 30.0, 31.0, 14.0, 10.0)
POSE = look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))
CAMS = camera_rows([POSE], [LENS], BOX)
ANCHORS = 5


def case(count: int = 40, anchors: int = ANCHORS, seed: int = 0) -> tuple[np.ndarray, ...]:
    """Parameters, anchor, share, image, plate, weight."""
    rng = np.random.default_rng(seed)
    anchor = np.argsort(rng.random((count, max(anchors, 3))), axis=1)[:, :3] % anchors
    share = rng.random((count, 3)).astype(np.float32)
    share[:, anchors:] = 0.0
    share /= share.sum(axis=1, keepdims=True)
    image = rng.integers(0, 256, (21, 29, 3), np.uint8)
    plate = rng.uniform(0, 255, (21, 29, 3)).astype(np.float32)
    weight = rng.choice([0.0, 0.5, 1.0], (21, 29)).astype(np.float32)
    weight[:8, 8:16] = 0.0
    return random_params(count, seed=seed), anchor, share, image, plate, weight


def aligned(params, anchor, share, image, plate, weight, anchors=ANCHORS):
    raster = binned(CAMS, params, differentiate=False)
    return align_view(raster, CAMS, params[:, :3], image, plate, weight, anchor, share, anchors)


def by_pixels(params, anchor, share, image, plate, weight, anchors=ANCHORS):
    """The reference: every Gaussian of every pixel with its own Jacobian (no lens distortion)."""
    raster = binned(CAMS, params, differentiate=False)
    turn = CAMS[0, :9].reshape(3, 3).astype(float)
    x, y, z = turn @ (params[:, :3] - CAMS[0, 9:12]).T.astype(float)
    rows = raster.projected.astype(float)
    slope = np.stack(
        [LENS.fx / z * (turn[0] - np.outer(x / z, turn[2])).T, LENS.fy / z * (turn[1] - np.outer(y / z, turn[2])).T]
    )
    matrix, vector = np.zeros((3 * anchors, 3 * anchors)), np.zeros(3 * anchors)
    shown = plate / 255.0
    lists = raster.lists
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            if weight[v, u] <= 0:
                continue
            t, light, used = v // 8 * raster.columns + u // 8, 1.0, []
            for i in lists.owner[lists.pair[lists.first[t] : lists.first[t + 1]]]:
                row = rows[i]
                dx, dy = u + 0.5 - row[MEAN_X], v + 0.5 - row[MEAN_Y]
                form = row[CONIC_A] * dx * dx + 2 * row[CONIC_B] * dx * dy + row[CONIC_C] * dy * dy
                a = min(row[ALPHA] * np.exp(-0.5 * form), ALPHA_MAX)
                if a >= ALPHA_MIN and light >= STOP:
                    h = a * np.array([row[CONIC_A] * dx + row[CONIC_B] * dy, row[CONIC_B] * dx + row[CONIC_C] * dy])
                    used.append((i, a, light, h if a < ALPHA_MAX else 0 * h))
                    light *= 1 - a
            behind, jacobian = plate[v, u] / 255.0, np.zeros((3, anchors, 3))
            for i, a, light, h in reversed(used):
                color = rows[i, RED : RED + 3]
                by = np.outer(light * (color - behind), h[0] * slope[0, :, i] + h[1] * slope[1, :, i])
                for k, s in zip(anchor[i], share[i], strict=True):
                    jacobian[:, k] += s * by
                behind = a * color + (1 - a) * behind
            shown[v, u] = behind
            error, j = image[v, u] / 255.0 - behind, jacobian.reshape(3, -1)
            w = weight[v, u] / (1 + error @ error / ROBUST**2) / NOISE**2
            matrix += w * j.T @ j
            vector += w * j.T @ error
    return matrix, vector, shown


@pytest.mark.parametrize("anchors", [1, 2, ANCHORS, 8])
def test_one_anchor_near_each_gaussian_is_a_gauss_newton_by_pixels(anchors):
    """Exact where the Gaussians of an anchor share a direction of sight: here they do."""
    params, anchor, share, image, plate, weight = case(anchors=anchors)
    params[:, :3] *= 1e-3
    matrix, vector, shown, _ = aligned(params, anchor, share, image, plate, weight, anchors)
    wanted, right, image_wanted = by_pixels(params, anchor, share, image, plate, weight, anchors)
    np.testing.assert_allclose(matrix, wanted, atol=2e-3 * np.abs(wanted).max())
    np.testing.assert_allclose(vector, right, atol=2e-3 * np.abs(right).max())
    seen = weight > 0
    np.testing.assert_allclose(shown[seen], image_wanted[seen], atol=1e-4)
    np.testing.assert_array_equal(matrix, matrix.T)
    assert np.linalg.eigvalsh(matrix).min() > -1e-5 * np.abs(wanted).max()


def test_nothing_is_said_without_weight_or_gaussians():
    params, anchor, share, image, plate, weight = case()
    matrix, vector, shown, opacity = aligned(params, anchor, share, image, plate, 0 * weight)
    assert not matrix.any() and not vector.any() and not opacity.any()
    np.testing.assert_allclose(shown, plate / 255.0, atol=1e-6)
    params[:, :3] += 100.0
    assert not aligned(params, anchor, share, image, plate, weight)[0].any()


def test_hard_gaussians_stay_finite():
    params, anchor, share, image, plate, weight = case(count=60)
    params[0, :3] = np.nan
    params[1, :3] = CAMS[0, 9:12]
    params[2, 3:6] = 30.0
    params[3, 10] = 80.0
    raster = RasterBuffers(Pool(1))
    raster.project_and_bin(CAMS, params, differentiate=False)
    for found in align_view(raster, CAMS, params[:, :3], image, plate, weight, anchor, share, ANCHORS):
        assert np.isfinite(found).all()
