"""Vector-matrix factors: forward and gradients against plain torch and against finite differences."""

import numpy as np
import torch

from edge_server.fields.tensorf.field import TensorfField, upsample_table
from edge_server.fields.tensorf.kernels import vector_matrix
from edge_server.fields.tensorf.kernels.vector_matrix import CHANNELS, ROWS, Planes
from edge_server.fields.tensorf.settings import TensorfSettings

SETTINGS = TensorfSettings(density_rank=8, color_rank=16, resolution_start=9, resolution=17, first=1.0)
AXES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # the plane's two axes and the line's


def _planes() -> Planes:
    planes: Planes = TensorfField(SETTINGS)._encoding
    return planes


def _points(count: int, chunks: int = 2):
    rng = np.random.default_rng(1)
    x = rng.random((chunks, 3, count), dtype=np.float32)
    x[0, :, 10], x[0, :, 11] = 0.0, np.float32(1.0)  # both ends of the cube
    return x, rng


def _oracle(planes: Planes, table: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    """Points (N, 3) -> all groups' components (N, groups, 8), by torch's own interpolation."""
    n, out = planes.size, []
    at = 2.0 * x - 1.0
    for g in range(planes.groups):
        rows = table[g * planes.rows : g * planes.rows + n * (n + 1)]
        u, v, w = AXES[g % 3]
        plane = rows[: n * n].reshape(n, n, CHANNELS).permute(2, 0, 1)[None]
        line = rows[n * n :].T.reshape(1, CHANNELS, n, 1)
        sample = torch.nn.functional.grid_sample
        on_plane = sample(plane, at[:, [u, v]][None, :, None], align_corners=True, padding_mode="border")
        along = torch.stack([torch.zeros_like(at[:, w]), at[:, w]], dim=-1)
        on_line = sample(line, along[None, :, None], align_corners=True, padding_mode="border")
        out.append((on_plane * on_line)[0, :, :, 0].T)
    return torch.stack(out, dim=1)


def test_density_and_components_equal_the_oracle() -> None:
    planes, (x, _) = _planes(), _points(300)
    raw, acts = np.full(300, np.nan, np.float32), np.full((60, 300), np.nan, np.float32)
    vector_matrix.raw_density(planes, x[0], 10, 290, raw)
    vector_matrix.color_components(planes, x[0], 10, 290, acts)
    expected = _oracle(planes, torch.as_tensor(planes.table), torch.as_tensor(x[0].T[10:290])).numpy()
    summed = planes.bias + expected[:, : planes.density_groups].sum(axis=(1, 2))
    np.testing.assert_allclose(raw[10:290], summed, atol=1e-3)
    rest = expected[:, planes.density_groups :].reshape(280, -1)
    np.testing.assert_allclose(acts[: rest.shape[1], 10:290].T, rest, atol=3e-4)
    raw[10:290] = acts[: rest.shape[1], 10:290] = np.nan
    assert np.isnan(raw).all() and np.isnan(acts).all(), "rows that are not the factors' or other samples were written"


def test_gradient_equals_the_oracle() -> None:
    planes, (x, rng) = _planes(), _points(100)
    d = rng.normal(size=(2, 49, 100)).astype(np.float32)
    d[:, :, 5:9] = 0.0  # samples that nothing depends on
    x *= np.float32(0.4)  # most of space is left alone
    counts = np.array([100, 37])
    gradient, dirty = np.zeros_like(planes.table), np.zeros(len(planes.table) // ROWS, np.bool_)
    vector_matrix.scatter_planes(np.zeros(1, np.int64), 0, planes, x, d, counts, gradient, dirty)
    table = torch.as_tensor(planes.table).requires_grad_(True)
    colors = (planes.groups - planes.density_groups) * CHANNELS
    for c, n in enumerate(counts):
        found, wanted = _oracle(planes, table, torch.as_tensor(x[c, :, :n].T)), torch.as_tensor(d[c, :, :n].T)
        of_color = (found[:, planes.density_groups :].reshape(n, colors) * wanted[:, :colors]).sum()
        of_density = (found[:, : planes.density_groups].sum(dim=(1, 2)) * wanted[:, colors]).sum()
        (of_color + of_density).backward()
    assert table.grad is not None
    np.testing.assert_allclose(gradient, table.grad.numpy(), atol=2e-3)
    touched = (gradient.reshape(len(dirty), -1) != 0).any(axis=1)
    assert (dirty >= touched).all() and not dirty.all()


def test_finer_planes_say_the_same() -> None:
    """Exactly at 2 n - 1 vertices a side."""
    planes, (x, _) = _planes(), _points(200)
    table = upsample_table(planes.table, planes.groups, planes.size, 17)
    fine = planes._replace(size=17, rows=len(table) // planes.groups, table=table)
    points = torch.as_tensor(x[0].T)
    before = _oracle(planes, torch.as_tensor(planes.table), points).numpy()
    np.testing.assert_allclose(_oracle(fine, torch.as_tensor(table), points).numpy(), before, atol=1e-4)
