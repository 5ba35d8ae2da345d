"""A whole chunk of rays, from weighted pixels to the gradients, and single ones, against plain torch."""

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from edge_server.fields import View
from edge_server.fields.common.kernels import volume_rendering as volume
from edge_server.fields.common.kernels.train import RaySampling, train_chunks
from edge_server.fields.common.supervision import pack_views
from edge_server.fields.common.training_schedule import step_length
from edge_server.fields.field_constants import GUIDE_REACH
from edge_server.fields.ngp.field import NgpField
from tests.edge_server.fields.small import KERNEL_SETTINGS as SETTINGS
from tests.edge_server.fields.small import KERNEL_VIEWS as VIEWS
from tests.edge_server.fields.small import kernel_field
from tests.edge_server.fields.torch_model import encode, mlp, ray_losses, shade, to_torch

DISTORTION = 0.2
SAMPLES = 24  # of single rays
LEVELS = 3  # of the encoding's four: those that are in use at first


def _train(
    field: NgpField, views: list[View] = VIEWS, rays: int = SETTINGS.rays, over: float = 1.0
) -> tuple[float, NDArray[np.float32], int]:
    """Loss, the network's gradient and number of rays of one chunk of at most ``rays``; the occupancy grid
    takes everything to be ``over`` times as dense as it knows."""
    ray_sampling = RaySampling(
        key=np.uint64(7),
        chunk_rays=rays,
        levels=LEVELS,
        sh_degree=SETTINGS.sh_degree,
        changed_share=np.float32(0.5),
        background=np.full(3, 0.5, np.float32),
        embeddings=np.zeros((len(VIEWS), 0), np.float32),
    )
    assert field.view_store.box is not None
    data = pack_views(views, field.view_store.box, field.view_store.memory)
    space = field._occupancy.space(step_length(SETTINGS, field.step))
    space = space._replace(density=space.density * np.float32(over))
    weights = volume.Weights(np.float32(DISTORTION))
    batch, scratch = field._batch, field._scratch
    field.pool.run(train_chunks, data, ray_sampling, space, field._encoding, field._net, weights, batch, scratch, ())
    return float(batch.loss[0]), batch.d_params[0].copy(), int(batch.rays[0])


def _oracle(field: NgpField, rays: int, weight: NDArray, grid: Any, params: Tensor) -> tuple[Tensor, Tensor]:
    """Color error and loss of the samples that the last chunk took, for an encoding and the network ``params``."""
    batch, scratch = field._batch, field._scratch
    first, ray = scratch.ray_first[0], scratch.ray[0]
    column = scratch.column[0, : first[rays]]
    x = torch.as_tensor(batch.x[0][:, column].T.copy(), dtype=torch.float64)
    toward = torch.as_tensor(ray[:rays, :3], dtype=torch.float64)
    toward = toward.repeat_interleave(torch.as_tensor(np.diff(first[: rays + 1])), dim=0)
    raw = mlp(field._net.widths.tolist(), params, encode(grid, LEVELS, x))
    sigma, color = shade(raw, SETTINGS.sh_degree, toward)
    error = loss = torch.zeros((), dtype=torch.float64)
    for r in range(rays):
        a, b = int(first[r]), int(first[r + 1])
        at = column[a:b]
        t, delta = (torch.as_tensor(scratch.line[0, k, at], dtype=torch.float64)[None] for k in (0, 1))
        target, back = (torch.as_tensor(ray[r, k : k + 3], dtype=torch.float64)[None] for k in (3, 6))
        of_ray = ray_losses(sigma[None, a:b], color[None, a:b], t, delta, target, back, DISTORTION)
        error, loss = error + weight[r] * of_ray[0].sum(), loss + weight[r] * of_ray[1].sum()
    return error, loss


@pytest.mark.parametrize("weighted", [False, True])
def test_loss_and_gradient_equal_the_oracle(weighted: bool) -> None:
    field = kernel_field()
    rng = np.random.default_rng(2)
    weights = [rng.choice(np.array([0.0, 0.3, 1.0], np.float32), v.image.shape[:2]) for v in VIEWS]
    views = [replace(v, weight=w) for v, w in zip(VIEWS, weights)] if weighted else VIEWS
    loss, gradient, rays = _train(field, views)
    weight = field._scratch.ray[0, :rays, 10] if weighted else np.ones(rays, np.float32)
    assert field._encoding.dense[:LEVELS].any() and not field._encoding.dense[:LEVELS].all()
    grid = to_torch(field._encoding)
    params = torch.as_tensor(field._net.params, dtype=torch.float64).requires_grad_(True)
    grid.table.requires_grad_(True)
    error, total = _oracle(field, rays, weight, grid, params)
    total.backward()
    assert rays > 20 and loss == pytest.approx(error.item(), rel=1e-4)
    field._gather(LEVELS)
    touched = field._table_g.reshape(len(field._dirty), -1).any(axis=1)
    assert (field._dirty >= touched).all() and not field._dirty.all()
    for found, learned in ((gradient, params), (field._table_g, grid.table)):
        assert learned.grad is not None
        expected = learned.grad.numpy()
        np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())
    field._table_g[:], field._dirty[:] = 0.0, False


def test_no_ray_is_cut_off_where_the_grid_is_wrong() -> None:
    field = kernel_field()

    def rays_of(over: float) -> list[NDArray[np.float32]]:
        _, _, rays = _train(field, rays=512, over=over)
        first, column = field._scratch.ray_first[0], field._scratch.column[0]
        return [field._scratch.line[0, 0, column[a:b]] for a, b in pairwise(first[: rays + 1])]

    whole = rays_of(0.0)  # nothing to be asked about: each in one span
    assert sum(map(len, whole)) > 1500 and all((np.diff(t) > 0).all() for t in whole)
    for over in (1.0, 5.0, 30.0):
        found = rays_of(over)
        assert len(found) > 0.8 * len(whole)
        for mine, other in zip(found, whole, strict=False):
            np.testing.assert_array_equal(mine, other)


def _ray(seed: int, density: float):
    rng = np.random.default_rng(seed)
    raw = rng.normal(size=(4, SAMPLES)).astype(np.float32)
    raw[0] += np.float32(density)
    line = np.zeros((3, SAMPLES), np.float32)
    line[0] = 1.0 + np.arange(SAMPLES) * 0.05
    line[1] = rng.uniform(0.02, 0.08, SAMPLES)
    return raw, line, rng.random(6).astype(np.float32)  # the ray's color and the background's


def _kernel(raw, line, ray, weights, guide=0.0):
    out, d_out = raw.copy(), np.zeros_like(raw)
    volume.activate(out, 0, SAMPLES)
    error = volume.ray_loss(out, d_out, *line, 0, SAMPLES, ray[:3], ray[3:], np.float32(guide), weights)
    return error, d_out


@pytest.mark.parametrize(("density", "guide"), [(1.0, 1.4), (-4.0, 50.0)])
def test_weight_away_from_a_guide_costs_what_geman_and_mcclure_say(density: float, guide: float) -> None:
    raw, line, ray = _ray(9, density)
    error, d_out = _kernel(raw, line, ray, volume.Weights(*np.float32([0.3, 0.7])), guide)
    params = torch.as_tensor(raw.T.copy(), dtype=torch.float64).requires_grad_(True)
    sigma, color = shade(params, 0, torch.zeros(SAMPLES, 3, dtype=torch.float64))
    t, delta = (torch.as_tensor(line[k], dtype=torch.float64) for k in (0, 1))
    target, back = (torch.as_tensor(ray[a : a + 3], dtype=torch.float64)[None] for a in (0, 3))
    expected, loss = ray_losses(sigma[None], color[None], t[None], delta[None], target, back, 0.3)
    assert error == pytest.approx(expected.item(), rel=1e-4)  # the guide is no color
    through = torch.exp(-torch.cumsum(sigma * delta, 0))
    before = torch.cat([torch.ones(1, dtype=torch.float64), through[:-1]])
    off = (t - guide) / (GUIDE_REACH * guide)
    away = ((before - through) * off**2 / (1 + off**2)).sum() + through[-1]
    (loss.sum() + 0.7 * away).backward()
    assert params.grad is not None
    np.testing.assert_allclose(d_out.T, params.grad.numpy(), atol=2e-5, rtol=2e-3)


def test_a_ray_ends_where_a_ten_thousandth_of_the_light_is_left() -> None:
    """Later, samples are evaluated for nothing; earlier, what is left out can be seen."""
    raw, line, ray = _ray(5, 0.0)
    line[1], raw[0] = 0.05, np.log(0.7 / 0.05)  # an optical depth of .7 a sample
    out = raw.copy()
    volume.activate(out, 0, SAMPLES)
    through = np.exp(-np.cumsum(out[0].astype(np.float64) * line[1]))
    seen = volume.samples_until_opaque(out, line[1], 0, SAMPLES)
    assert through[seen - 1] < 1e-4 < through[seen - 2]
    error, d_out = _kernel(raw, line, ray, volume.Weights(np.float32(0)))
    weight = np.concatenate([[1.0], through[:-1]]) - through
    color = (weight * out[1:4]).sum(axis=1) + through[-1] * ray[3:]
    assert error == pytest.approx(float(np.square(color - ray[:3]).sum()), abs=3e-4)
    assert (d_out[0, seen:] == 0).all() and (d_out[0, :seen] != 0).all()


def test_clamped_density_and_what_is_not_finite_have_no_gradient() -> None:
    raw, line, ray = _ray(6, 0.0)
    raw[0, 0], raw[0, 1] = -40.0, -11.0
    _, d_out = _kernel(raw, line, ray, volume.Weights(np.float32(0)))
    assert d_out[0, 0] == 0.0 and d_out[0, 1] != 0.0
    raw[0, 2] = 500.0  # overflows an unclamped exponential
    error, d_out = _kernel(raw, line, ray, volume.Weights(np.float32(0)))
    assert np.isfinite(error) and error >= 0 and np.isfinite(d_out).all() and d_out[0, 2] == 0.0
    raw[2, 1] = np.inf  # full color
    assert np.isfinite(_kernel(raw, line, ray, volume.Weights(np.float32(0.1)))[1]).all()
    raw[2, 1] = np.nan
    error, d_out = _kernel(raw, line, ray, volume.Weights(np.float32(0.1)))
    assert error == -1.0 and (d_out == 0).all(), "a ray that is not finite is refused whole"
