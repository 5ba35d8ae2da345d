"""The kernels of stereo against plain numpy."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.plane_sweep import _pixels_of_row
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.threads.thread_pool import CallerPool, Pool
from edge_server.fields.splat import splat_constants as tuned
from edge_server.fields.splat.kernels.semi_global import (
    COST,
    UNKNOWN,
    _project_ray,
    aggregate_paths,
    choose_depths,
    match_costs,
)
from freshfield.geometry import Pinhole, look_at, se3_inverse, seen_from

WIDTH, HEIGHT, STEPS = 21, 18, 11
LENS = Pinhole(WIDTH, HEIGHT, 19.0, 20.0, 10.2, 9.1, (0.05, -0.02, 0.004, 0.003))
INVERSE = np.linspace(0.0, 1.2, STEPS).astype(np.float32)
POSES = [look_at(eye, (0.0, 0.0, 0.0)) for eye in ((0.3, -2.0, 0.1), (1.2, -1.8, 0.2), (-0.9, -1.6, 0.5), (1.9, 0, 0))]


def _difference(image: NDArray, other: NDArray, to_other: NDArray, d: int) -> tuple[NDArray, NDArray]:
    """Cost of one inverse depth (H, W) by another image, and where that shows it."""
    rays = LENS.rays() / LENS.rays()[..., 2:]
    local = rays @ to_other[:3, :3].T + INVERSE[d] * to_other[:3, 3]
    _, at, inside = seen_from(LENS, np.eye(4), local.reshape(-1, 3))
    (u, v), seen = at.T.reshape(2, HEIGHT, WIDTH) - 0.5, inside.reshape(HEIGHT, WIDTH)
    u, v = np.clip(np.where(seen, u, 0), 0, WIDTH - 1), np.clip(np.where(seen, v, 0), 0, HEIGHT - 1)
    x, y = np.minimum(u.astype(int), WIDTH - 2), np.minimum(v.astype(int), HEIGHT - 2)
    fu, fv = u - x, v - y
    above = other[:, y, x] * (1 - fu) + other[:, y, x + 1] * fu
    below = other[:, y + 1, x] * (1 - fu) + other[:, y + 1, x + 1] * fu
    worst = np.abs(above * (1 - fv) + below * fv - image).max(axis=0)
    seen &= worst <= 1.0
    return np.where(seen, np.minimum(worst / tuned.SWEEP_BOUND, 1.0) * COST, COST * tuned.SWEEP_UNSEEN), seen


@pytest.fixture(scope="module")
def images() -> NDArray[np.float32]:
    found = np.random.default_rng(3).random((4, 3, HEIGHT, WIDTH)).astype(np.float32) * np.float32(0.3)
    found[1, :, 4:7, 3:9] = UNKNOWN
    return found


def _costs(images: NDArray[np.float32], pool: Pool) -> NDArray[np.uint8]:
    others = POSES[1 : len(images)]
    rows = camera_rows([se3_inverse(POSES[0]) @ pose for pose in others], [LENS] * len(others), UNIT_BOX)
    rays = LENS.rays()
    across, down = (np.ascontiguousarray(rays[..., k] / rays[..., 2], dtype=np.float32) for k in (0, 1))
    cost = np.empty((HEIGHT, WIDTH, STEPS), np.uint8)
    pool.run(match_costs, images[0], images[1:].reshape(-1, 3, WIDTH * HEIGHT), rows, across, down, INVERSE, cost)
    return cost


@pytest.mark.parametrize("count", [2, 4])
def test_costs_are_those_of_the_images_that_differ_least(images: NDArray[np.float32], count: int) -> None:
    found = _costs(images[:count], CallerPool())
    unseen_somewhere = False
    for d in range(STEPS):
        each = []
        for j in range(1, count):
            differs, seen = _difference(images[0], images[j], se3_inverse(POSES[j]) @ POSES[0], d)
            each.append(np.where(seen, uniform_filter(differs, 3, mode="nearest"), np.inf))
        first, second = np.sort([*each, np.full((HEIGHT, WIDTH), np.inf)], axis=0)[:2]
        weigh = (count - 1 >= tuned.SWEEP_SECOND_OF) & np.isfinite(second)
        expected = first + tuned.SWEEP_SECOND * np.where(weigh, np.where(weigh, second, 0) - first, 0)
        unseen_somewhere |= bool(np.isinf(first).any())
        expected = np.where(np.isfinite(first), expected, COST * tuned.SWEEP_UNSEEN)
        # Each of nine differences is rounded down, and their mean; what lies on a border may fall to either side.
        assert (np.abs(found[..., d] + 1.0 - expected) <= 1.1).mean() > 0.99
    assert unseen_somewhere
    pool = Pool(3)
    np.testing.assert_array_equal(_costs(images[:count], pool), found)
    pool.close()


def test_nothing_far_aside_is_seen_where_the_lens_folds_it_back() -> None:
    """By stereo, and by the sweep of cells."""
    lens = replace(Pinhole.from_fov(64, 48, 50.0), distortion=(-0.25, 0.0, 0.0, 0.0))
    camera, aside = tuple(camera_rows([np.eye(4)], [lens], UNIT_BOX)[0]), np.linspace(0.0, 3.9, 14, dtype=np.float32)
    swept, matched, pixel, place = np.zeros(14, np.int32), [], np.zeros(1, np.int32), np.zeros((2, 1), np.float32)
    cells = np.stack([aside, np.zeros_like(aside), np.ones_like(aside)])
    _pixels_of_row(camera, np.int32(0), np.int32(64), np.int32(48), np.int32(-1), cells, swept)
    for x in aside:
        _project_ray(camera, x, np.float32(0.0), np.ones(1, np.float32), pixel, *place)
        matched.append(pixel[0])
    for found in (swept, np.array(matched)):
        assert (found[:2] >= 0).all() and (found[2:] == -1).all()


def _paths(cost: NDArray[np.uint8], gray: NDArray[np.float32]) -> NDArray[np.int64]:
    small, total = int(COST * tuned.SWEEP_SMALL), np.zeros(cost.shape, np.int64)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        ends = np.zeros(cost.shape, np.int64)
        for y in range(HEIGHT)[:: dy or 1]:
            for x in range(WIDTH)[:: dx or 1]:
                ends[y, x] = cost[y, x]
                if 0 <= y - dy < HEIGHT and 0 <= x - dx < WIDTH:
                    before = ends[y - dy, x - dx]
                    change = abs(gray[y, x] - gray[y - dy, x - dx])
                    jump = int(np.float32(COST * tuned.SWEEP_LARGE) / (1 + np.float32(tuned.SWEEP_EDGE) * change))
                    beside = np.pad(before, 1, mode="edge") + small
                    ways = [before, beside[:-2], beside[2:], np.full(STEPS, before.min() + jump)]
                    ends[y, x] += np.min(ways, axis=0) - before.min()
        total += ends
    return total


def test_paths_add_up_the_least_costs(images: NDArray[np.float32]) -> None:
    cost = np.random.default_rng(4).integers(0, COST + 1, (HEIGHT, WIDTH, STEPS)).astype(np.uint8)
    gray = np.ascontiguousarray(images[0, 0])
    total = np.empty((2, *cost.shape), np.uint16)
    CallerPool().run(aggregate_paths, cost, gray, total)
    np.testing.assert_array_equal(total.sum(axis=0, dtype=np.int64), _paths(cost, gray))


def test_the_depth_of_least_cost_lies_between_steps() -> None:
    """Of a parabola the least, wherever it is; of costs that are all alike none."""
    least = np.linspace(0.0, STEPS - 1.0, WIDTH * HEIGHT).reshape(HEIGHT, WIDTH)
    total = (200.0 * (np.arange(STEPS) - least[..., None]) ** 2).astype(np.uint16)
    total, found = np.stack([total, total]), np.empty((HEIGHT, WIDTH), np.float32)
    CallerPool().run(choose_depths, total, INVERSE, found)
    np.testing.assert_allclose(found, least * INVERSE[1], atol=0.02 * INVERSE[1])
    CallerPool().run(choose_depths, np.full_like(total, 7), INVERSE, found)
    assert (found == 0.0).all()
