"""Training over a plate: one of a single color is a background; any other agrees with differences."""

from __future__ import annotations

import numpy as np

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.threads.thread_pool import CallerPool, Pool
from edge_server.fields.splat.buffers import RasterBuffers
from edge_server.fields.splat.kernels.project import RED
from edge_server.fields.splat.kernels.rasterize import Background, train_tiles
from edge_server.fields.splat.layers.kernels.train_over import train_over
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, binned, random_params

LENS = Pinhole(29, 21, 30.0, 31.0, 14.0, 10.0)
CAMS = camera_rows([look_at((1.0, -2.5, 0.8), (0.05, 0.0, 0.1))], [LENS], BOX)
RNG = np.random.default_rng(0)
IMAGE = RNG.integers(0, 256, (21, 29, 3), np.uint8)
PLATE = RNG.uniform(0, 255, (21, 29, 3)).astype(np.float32)
WEIGHT = RNG.choice([0.0, 0.5, 1.0], (21, 29)).astype(np.float32)


def _trained(raster: RasterBuffers, plate: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Losses of the tiles, and the sums of the pairs that are in a list."""
    tasks = raster.tasks()
    losses = np.full(len(tasks), np.nan)
    raster.pool.run(
        train_over,
        IMAGE,
        plate,
        weight,
        tasks,
        raster.columns,
        raster.projected,
        raster.lists,
        raster.memory,
        raster.saved,
        raster.sums,
        losses,
    )
    return losses, raster.sums[0, : int(raster.lists.needed[0])].copy()


def test_a_plate_of_one_color_is_a_background() -> None:
    raster, color = binned(CAMS, random_params(30)), np.array([0.2, 0.6, 0.4], np.float32)
    losses, sums = _trained(raster, np.broadcast_to(color * 255, IMAGE.shape).astype(np.float32), np.ones_like(WEIGHT))
    tasks, expected = raster.tasks(), np.zeros((len(raster.tasks()), 2))
    views = Views(
        first=np.array([0, 21 * 29]),
        size=np.array([[29, 21]]),
        lens=np.zeros((1, 8)),
        rotation=np.zeros((1, 3, 3)),
        origin=np.zeros((1, 3)),
        pixels=IMAGE.reshape(-1, 3),
        changed=np.zeros(0, np.int64),
    )
    raster.pool.run(
        train_tiles,
        views,
        np.zeros(1, np.int64),
        tasks,
        raster.columns,
        raster.projected,
        raster.lists,
        Background(color, False, np.uint64(0)),
        raster.memory,
        raster.saved,
        raster.sums,
        expected,
    )
    filled = np.diff(raster.lists.first[0, : len(tasks) + 1]) > 0
    np.testing.assert_allclose(losses[filled], expected[filled, 0], rtol=1e-5)
    np.testing.assert_allclose(sums, raster.sums[0, : len(sums)], rtol=2e-4, atol=2e-4)
    assert not losses[~filled].any()


def test_slopes_over_a_plate_agree_with_differences() -> None:
    raster = binned(CAMS, random_params(30))
    _, sums = _trained(raster, PLATE, WEIGHT)
    for i in range(0, 30, 5):
        first, count = int(raster.lists.own_first[0, i]), int(raster.lists.own_count[0, i])
        for c in range(3):
            old, step, total = raster.projected[0, i, RED + c], np.float32(0.02), []
            for sign in (1, -1):
                raster.projected[0, i, RED + c] = old + sign * step
                total.append(_trained(raster, PLATE, WEIGHT)[0].sum())
            raster.projected[0, i, RED + c] = old
            expected = (total[0] - total[1]) / (2 * step)
            np.testing.assert_allclose(sums[first : first + count, 6 + c].sum(), expected, rtol=5e-3, atol=5e-3)


def test_the_number_of_threads_changes_nothing() -> None:
    one, two = (
        _trained(binned(CAMS, random_params(30), pool=pool), PLATE, WEIGHT) for pool in (CallerPool(), Pool(2, 0))
    )
    for a, b in zip(one, two, strict=True):
        np.testing.assert_array_equal(a, b)
