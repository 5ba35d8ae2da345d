"""Depth plates: medians over time, planes fitted to inverse depths, small holes; depth of what moves. All against the
same rules in plain numpy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields.common.threads.thread_pool import CallerPool, Pool
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate, smooth
from edge_server.fields.splat.layers.depth.kernels.body_depth import measure_body

POOL = CallerPool()


def _plane(inverse: NDArray[np.float32], image: NDArray[np.float32], y: int, x: int) -> tuple[float, float, float]:
    """``fit_planes`` at one pixel, in numpy and float64: inverse depth and its two slopes."""
    q = inverse.astype(float)
    j, i = np.mgrid[: q.shape[0], : q.shape[1]]
    dx, dy = i - x, j - y
    near = q[(np.abs(dx) <= 1) & (np.abs(dy) <= 1) & (q > 0)]
    a, b, c = float(np.median(near)), 0.0, 0.0
    if len(near) < 4 and abs(a - q[y, x]) > 4 * tuned.NOISE:
        a = q[y, x]
    window = (np.maximum(np.abs(dx), np.abs(dy)) <= tuned.RADIUS) & (q > 0)
    color = np.abs(image.astype(float) - image[y, x]).sum(axis=2) / tuned.SMOOTH_COLOR
    for k in range(tuned.ROUNDS):
        e = (q - (a + b * dx + c * dy)) / (tuned.NOISE * (2.0 if k == 0 else 1.0))
        w = np.exp(-(dx**2 + dy**2) / (2.0 * tuned.SPREAD_PX**2)) / ((1 + e**2) * (1 + color**2))
        w = w * (window & (np.abs(e) <= tuned.OUTLIER))
        if w.sum() < 0.5:
            break
        mx, my = (w * dx).sum() / w.sum(), (w * dy).sum() / w.sum()
        design = np.stack([dx - mx, dy - my], axis=-1).reshape(-1, 2)
        normal = design.T @ (design * w.reshape(-1, 1)) + 0.05 * w.sum() * np.eye(2)
        b, c = np.linalg.solve(normal, design.T @ (w * q).ravel())
        a = (w * q).sum() / w.sum() - b * mx - c * my
    return a, b, c


def _scene(rng: np.random.Generator, size: int = 24) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Inverse depths of a slanted wall before another one, with noise and holes, and an image."""
    y, x = np.mgrid[:size, :size]
    q = np.where(x < size // 2, 0.5 + 0.01 * x, 0.25 + 0.004 * y)
    q += tuned.NOISE * 0.7 * rng.standard_normal((size, size))
    q[rng.random((size, size)) < 0.05] = 0.0
    image = np.where((x < size // 2)[..., None], 60.0, 180.0) + rng.uniform(0, 10, (size, size, 3))
    return q.astype(np.float32), image.astype(np.float32)


def test_medians_are_those_of_numpy() -> None:
    rng = np.random.default_rng(1)
    plate = DepthPlate.empty(9, 11)
    for _ in range(40):
        depth = rng.uniform(1.0, 1.0 + rng.random((9, 11)) * 0.3).astype(np.float32)
        plate.take(np.where(rng.random((9, 11)) < 0.6, depth, 0).astype(np.float32), rng.random((9, 11)) < 0.2)
    assert plate.count.max() > tuned.KEPT and plate.is_known(np.ones((9, 11), bool))
    found = plate.medians(POOL)
    assert (found == 0).any() and (found > 0).any()
    for y, x in np.ndindex(9, 11):
        kept = plate.samples[y, x, : min(plate.count[y, x], tuned.KEPT)]
        median = np.median(kept) if len(kept) >= tuned.LEAST else 0.0
        steady = 3 * np.count_nonzero(np.abs(kept - np.float32(median)) < tuned.STEADY) >= 2 * len(kept)
        assert found[y, x] == pytest.approx(median if steady else 0.0, rel=1e-6)


def test_planes_are_those_of_numpy_whatever_the_number_of_threads() -> None:
    inverse, image = _scene(np.random.default_rng(2))
    found, slope = smooth(inverse, image, POOL)
    for y, x in np.ndindex(*inverse.shape):
        if inverse[y, x] > 0:
            np.testing.assert_allclose((found[y, x], *slope[y, x]), _plane(inverse, image, y, x), rtol=2e-3, atol=2e-4)
    pool = Pool(2)
    for mine, theirs in zip(smooth(inverse, image, pool), (found, slope)):
        np.testing.assert_array_equal(mine, theirs)
    pool.close()


def test_small_holes_are_filled_by_the_plane_of_a_pixel_beside_them() -> None:
    inverse, image = _scene(np.random.default_rng(3))
    found, slope = smooth(inverse, image, POOL)
    y, x = np.mgrid[:24, :24]
    for hole in np.argwhere(inverse == 0):
        dy, dx = hole[0] - y, hole[1] - x
        beside = (inverse > 0) & (np.maximum(np.abs(dx), np.abs(dy)) <= tuned.HOLE_PX)
        continued = found + slope[..., 0] * dx + slope[..., 1] * dy
        same = np.isclose(continued, found[*hole], rtol=1e-5) & (slope == slope[*hole]).all(axis=2)
        assert found[*hole] > 0 and (same & beside).any()


@pytest.mark.parametrize("turns", range(4))
def test_a_wide_hole_at_a_border_stays_but_for_its_rim(turns: int) -> None:
    inverse = np.full((20, 20), 0.5, np.float32)
    inverse[:, : tuned.HOLE_PX + 4] = 0.0
    found = np.rot90(smooth(np.rot90(inverse, turns).copy(), np.full((20, 20, 3), 90.0), POOL)[0], -turns)
    assert (found[:, :4] == 0).all()
    np.testing.assert_allclose(found[:, 4:], 0.5, rtol=1e-5)


@pytest.mark.stability
def test_what_no_sensor_measures_is_no_depth() -> None:
    plate = DepthPlate.empty(2, 4)
    broken = np.array([[np.nan, np.inf, -np.inf, -1.0], [0.0, -0.0, 1e9, 3.0]], np.float32)
    for _ in range(5):
        plate.take(broken, np.zeros((2, 4), bool))
    found = plate.medians(POOL)
    np.testing.assert_allclose(found, [[0, 0, 0, 0], [0, 0, 0, 1 / 3]], rtol=1e-6)
    assert np.isfinite(smooth(found, np.zeros((2, 4, 3), np.float32), POOL)[0]).all()


@pytest.mark.stability
@pytest.mark.parametrize("factor", [10.0, 0.1, 1000.0, 0.3048])
def test_depth_of_another_unit_is_refused_until_it_stays(factor: float) -> None:
    depth, nothing = np.full((24, 24), 2.0, np.float32), np.zeros((24, 24), bool)
    plate, pool = DepthPlate.empty(24, 24), CallerPool()
    assert all(plate.take(depth, nothing) for _ in range(4))
    # A person in the middle is no other unit, nor are holes.
    near = depth.copy()
    near[8:16] = 0.8
    near[16:20] = 0.0
    assert plate.take(near, nothing)
    wrong = depth * np.float32(factor)
    assert not any(plate.take(wrong, nothing) for _ in range(tuned.MOST_REFUSED))
    np.testing.assert_allclose(plate.medians(pool), 0.5)
    assert all(plate.take(wrong, nothing) for _ in range(4)) and plate.refused == 0
    np.testing.assert_allclose(plate.medians(pool), 0.5 / factor, rtol=1e-5)


# --- of what moves ----------------------------------------------------------------------------------

H, W = 23, 31
# In numbers, so that a change of them is seen.
OFF_PLATE, NEARER_M, NEARER, RADIUS, LEAST, FLYING = 16.0, 0.1, 0.03, 2, 4, 0.5 / 21.25


def _body_depth(depth: np.ndarray, plate_depth: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What the kernel finds, and what the rules say."""
    rng = np.random.default_rng(seed)
    foreground, image = rng.random((H, W)) < 0.8, rng.integers(0, 255, (H, W, 3), np.uint8)
    plate = (image + rng.uniform(-40, 40, (H, W, 3))).astype(np.float32)
    found, inverse = np.full((H, W), np.nan, np.float32), np.empty((H, W), np.float32)
    known, unsteady = plate_depth > 0, rng.random((H, W)) < 0.1
    samples = np.where(known, 1.0 / np.where(known, plate_depth, 1.0), 0.0)[..., None].repeat(3, axis=2)
    samples[unsteady] = 0.2, 0.4, 0.6
    count = np.where(known | unsteady, 3, 2).astype(np.int32)
    measure_body(depth, foreground, image, plate, samples.astype(np.float32), count, inverse, found)
    off = np.abs(image.astype(np.float32) - plate).max(axis=2)
    with np.errstate(all="ignore"):
        nearer = (plate_depth <= 0) | (depth < plate_depth - np.maximum(NEARER_M, NEARER * plate_depth))
        used = foreground & ~unsteady & (depth > 1e-3) & (depth < 1e6) & nearer & (off > OFF_PLATE)
        q = np.where(used, np.float32(1.0) / depth, 0).astype(np.float32)
    expected = np.zeros((H, W))
    for y, x in np.argwhere(q > 0):
        near = q[max(y - RADIUS, 0) : y + RADIUS + 1, max(x - RADIUS, 0) : x + RADIUS + 1]
        near = near[near > 0]
        alike = near[np.abs(near - q[y, x]) < FLYING]
        if len(near) >= LEAST and abs(np.sort(near)[len(near) // 2] - q[y, x]) < FLYING:
            expected[y, x] = 1.0 / alike.mean(dtype=np.float64)
    return found, expected


def test_what_is_in_front_of_the_plate_is_smoothed() -> None:
    """Two surfaces, noise, holes, and pixels that fly between the two; a plate that is partly unknown."""
    rng = np.random.default_rng(1)
    depth = np.where(np.arange(W) < W // 2, 1.5, 2.4) * np.ones((H, W)) + rng.normal(0, 0.01, (H, W))
    flies = rng.random((H, W)) < 0.1
    depth = np.where(flies, rng.uniform(1.5, 2.4, (H, W)), depth) * (rng.random((H, W)) > 0.2)
    plate_depth = np.where(rng.random((H, W)) < 0.3, 0.0, rng.choice([2.45, 3.0], (H, W)))
    found, expected = _body_depth(depth.astype(np.float32), plate_depth.astype(np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert 100 < (found > 0).sum() < (depth > 0).sum()


@pytest.mark.stability
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0, 1e-42, 3e38])
def test_depth_that_is_none_measures_nothing(value: float) -> None:
    depth = np.full((H, W), value, np.float32)
    depth[:, : W // 2] = 1.5
    found, expected = _body_depth(depth, np.full((H, W), 3.0, np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert found.any() and not found[:, W // 2 :].any()
