"""Depth of what moves, and what it sees through, against the same rules in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.layers.depth.kernels.body_depth import count_seen_through, measure_body
from tests.edge_server.fields.scenes import ring

H, W = 23, 31
# In numbers, so that a change of them is seen.
OFF_PLATE, NEARER_M, NEARER, RADIUS, LEAST, FLYING = 16.0, 0.1, 0.03, 2, 4, 0.5 / 21.25
THROUGH_M, THROUGH = 0.06, 0.02


def _measured(depth: np.ndarray, plate_depth: np.ndarray, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """What the kernel finds, and what the rules say."""
    rng = np.random.default_rng(seed)
    foreground, image = rng.random((H, W)) < 0.8, rng.integers(0, 255, (H, W, 3), np.uint8)
    plate = (image + rng.uniform(-40, 40, (H, W, 3))).astype(np.float32)
    found, inverse = np.full((H, W), np.nan, np.float32), np.empty((H, W), np.float32)
    known, unsteady = plate_depth > 0, rng.random((H, W)) < 0.1
    samples = np.where(known, 1.0 / np.where(known, plate_depth, 1.0), 0.0)[..., None].repeat(3, axis=2)
    samples[unsteady] = 0.2, 0.4, 0.6
    count = np.where(known | unsteady, 3, 2).astype(np.int32)
    CallerPool().run(measure_body, depth, foreground, image, plate, samples.astype(np.float32), count, inverse, found)
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
    found, expected = _measured(depth.astype(np.float32), plate_depth.astype(np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert 100 < (found > 0).sum() < (depth > 0).sum()


@pytest.mark.stability
@pytest.mark.parametrize("value", [0.0, np.nan, np.inf, -1.0, 1e-42, 3e38])
def test_depth_that_is_none_measures_nothing(value: float) -> None:
    depth = np.full((H, W), value, np.float32)
    depth[:, : W // 2] = 1.5
    found, expected = _measured(depth, np.full((H, W), 3.0, np.float32))
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    assert found.any() and not found[:, W // 2 :].any()


def test_gaussians_are_counted_where_all_that_was_measured_lies_behind() -> None:
    view, rng = ring(7, 32)[2], np.random.default_rng(3)
    box = scene_box(ring(7, 32))
    rows = camera_rows([view.camera_to_world], [view.intrinsics], box)
    points_m = rng.uniform(-1.2, 1.2, (400, 3))
    depth = (rng.uniform(2.0, 3.5, (32, 32)) * (rng.random((32, 32)) < 0.3)).astype(np.float32)
    depth[:4] = np.nan
    through = np.full(400, 5, np.int32)
    points = box.normalise(points_m).astype(np.float32)
    CallerPool().run(count_seen_through, rows, points, depth, np.float32(1.0 / box.radius_m), through)
    local = (points_m - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
    expected = np.zeros(400, np.int32)
    for i, ((x, y), z) in enumerate(zip(view.intrinsics.project(local), local[:, 2], strict=True)):
        if z * 1.0 > rows[0, 24] * box.radius_m and 1 <= x < 31 and 1 <= y < 31:
            near = depth[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2]
            near = near[near > 0]
            expected[i] = len(near) > 0 and near.min() >= z * (1 + THROUGH) + THROUGH_M
    np.testing.assert_array_equal(through - 5, expected)
    assert 40 < expected.sum() < 300
