"""Hash encoding: forward and table gradient against plain torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edge_server.fields.common.kernels.hash_grid import SEGMENT, encode, scatter
from edge_server.fields.common.model_layout import make_grid
from edge_server.fields.ngp.settings import NgpSettings
from tests.edge_server.fields import torch_model

SETTINGS = NgpSettings(levels=5, log2_table=10, base_resolution=4, finest_resolution=60)


def _case(points: int, chunks: int = 2):
    rng = np.random.default_rng(1)
    grid = make_grid(SETTINGS, None, rng)
    grid.table[:] = rng.normal(size=grid.table.shape)
    x = rng.random((chunks, 3, points), dtype=np.float32)
    x[0, :, 10], x[0, :, 11] = 0.0, np.float32(1.0)  # both ends of the cube
    return grid, x, rng


@pytest.mark.parametrize("levels", [5, 3])
def test_features_equal_the_oracle(levels: int) -> None:
    grid, x, _ = _case(300)
    assert grid.dense.any() and not grid.dense.all()
    features = np.full((12, 300), np.nan, np.float32)
    encode(grid, levels, x[0], 10, 290, features)
    expected = torch_model.encode(torch_model.to_torch(grid), levels, torch.as_tensor(x[0].T[10:290]))
    np.testing.assert_allclose(features[:10, 10:290].T, expected.numpy(), atol=2e-5)
    features[:10, 10:290] = np.nan
    assert np.isnan(features).all(), "rows that are not the grid's or other samples were written"


def test_table_gradient_equals_the_oracle() -> None:
    grid, x, rng = _case(200)
    counts = np.array([200, 150])
    d_features = rng.normal(size=(2, 12, 200)).astype(np.float32)
    gradient = np.zeros_like(grid.table)
    dirty = np.zeros(len(grid.table) // SEGMENT, np.bool_)
    scatter(np.zeros(1, np.int64), 0, grid, 4, x, d_features, counts, gradient, dirty)
    oracle = torch_model.to_torch(grid)
    oracle.table.requires_grad_(True)
    for c in range(2):
        features = torch_model.encode(oracle, 4, torch.as_tensor(x[c].T[: counts[c]]))
        (features * torch.as_tensor(d_features[c, :10, : counts[c]].T)).sum().backward()
    assert oracle.table.grad is not None
    np.testing.assert_allclose(gradient, oracle.table.grad.numpy(), atol=1e-4)
    touched = (gradient.reshape(len(dirty), -1) != 0).any(axis=1)
    assert (dirty >= touched).all() and not dirty.all()
