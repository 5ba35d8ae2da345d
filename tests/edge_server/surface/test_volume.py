"""Truncated signed distances: the kernel against plain numpy, and a volume's limits."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.surface import SurfaceError
from edge_server.surface.kernels.fuse import SIDE
from edge_server.surface.volume import Grid, bounding_box, fuse_maps
from tests.edge_server.surface import ball
from tests.edge_server.surface.ball import ball_maps, plain_fuse, voxel_points

BOX = Grid((-0.13,) * 3, (0.13,) * 3, 0.008, 0.032)


@pytest.mark.parametrize("camera", [ball.LENS, ball.DISTORTED_LENS, ball.TILTED_LENS])
def test_the_kernel_fuses_as_the_equations_say(camera):
    maps = ball_maps(5, camera)
    volume = fuse_maps(BOX, maps)
    rng = np.random.default_rng(0)
    number, cell = rng.integers(0, len(volume.blocks.place), 400), rng.integers(0, SIDE**3, 400)
    distance, weight = plain_fuse(BOX, maps, voxel_points(volume)[number, cell])
    assert (weight > 0).mean() > 0.3
    np.testing.assert_allclose(volume.blocks.weight[number, cell], weight, atol=2e-5)
    np.testing.assert_allclose(volume.blocks.distance[number, cell], distance, atol=1e-6)


def test_the_number_of_threads_changes_no_bit():
    maps = ball_maps(6)
    one, three = (fuse_maps(BOX, maps, pool=pool) for pool in (Pool(1, nice=0), Pool(3, nice=0)))
    for a, b in zip(one.blocks, three.blocks):
        np.testing.assert_array_equal(a, b)


def test_too_fine_a_grid_says_what_would_do():
    maps = ball_maps(4)
    needs = r"2 mm voxels need \d+ MB, more than the 5 allowed: take [\d.]+ mm"
    with pytest.raises(SurfaceError, match=needs):
        fuse_maps(Grid((-0.13,) * 3, (0.13,) * 3, 0.002, 0.008), maps, memory_mb=5)
    for grid, said in (
        (((-50.0,) * 3, (50.0,) * 3, 0.001, 0.004), "voxels are too many"),
        (((0, 0, 0), (1, 1, 1), 0.1, 0.05), "at least one voxel"),
        (((0, 0, 1), (1, 1, 1), 0.1, 0.4), "lower corner"),
    ):
        with pytest.raises(SurfaceError, match=said):
            Grid(*grid)


def test_bounds_are_those_of_what_is_seen():
    low, high = bounding_box(ball_maps(), 0.01)
    assert np.allclose(low, -0.11, atol=0.006) and np.allclose(high, 0.11, atol=0.006)
