"""A distance function fitted to depth: the ball it is of, its slope, and the same bits on any threads."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edge_server.surface.kernels.fuse import SIDE
from edge_server.surface.mesh import extract_mesh, remove_small_components
from edge_server.surface.sdf import fit_sdf, gradient_norm, sample_grid
from edge_server.surface.settings import SdfSettings
from edge_server.surface.volume import Grid
from tests.edge_server.surface.ball import RADIUS_M, ball_maps, voxel_points

GRID = Grid((-0.13,) * 3, (0.13,) * 3, 0.008, 0.032)


def test_distances_are_those_of_the_ball_with_a_slope_of_one():
    pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
    volume = fit_sdf(GRID, ball_maps(16), settings=SdfSettings(levels=2, steps=60, points=4000, eikonal=0.3))
    truth = np.linalg.norm(voxel_points(volume), axis=-1) - RADIUS_M
    assert np.abs(volume.blocks.distance - truth)[np.abs(truth) < 0.01].mean() < 0.0015
    radius = np.linalg.norm(remove_small_components(extract_mesh(volume)).vertices, axis=1)
    assert abs(radius.mean() - RADIUS_M) < 0.0007
    distance = volume.blocks.distance.reshape(-1, SIDE, SIDE, SIDE)
    known = (np.abs(truth) < 0.02).reshape(distance.shape)[:, 1:-1, 1:-1, 1:-1]
    parts = [np.gradient(distance, GRID.voxel_m, axis=k)[:, 1:-1, 1:-1, 1:-1] for k in (1, 2, 3)]
    steep = np.abs(np.sqrt(sum(p**2 for p in parts)) - 1.0)[known].mean()
    assert steep < 0.12, "without the eikonal term it is 0.20"


def test_values_between_nodes_and_their_slope():
    x, y, z = torch.meshgrid(*[torch.arange(n) * 0.5 for n in (5, 6, 7)], indexing="ij")
    plane = (0.6 * x + 0.8 * z + 0.0 * y)[None, None]
    extent, points = torch.tensor([2.0, 2.5, 3.0]), torch.tensor([[1.0, 1.2, 1.1], [0.8, 0.9, 2.2]])
    torch.testing.assert_close(sample_grid(plane, points, extent), 0.6 * points[:, 0] + 0.8 * points[:, 2])
    torch.testing.assert_close(gradient_norm(plane, points, extent, 0.5), torch.ones(2))


def test_the_number_of_threads_changes_no_bit():
    maps, before = ball_maps(4), torch.get_num_threads()
    found = []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            volume = fit_sdf(GRID, maps, settings=SdfSettings(levels=2, steps=10, points=2000))
            found.append(volume.blocks.distance)
    finally:
        torch.set_num_threads(before)
    np.testing.assert_array_equal(*found)
