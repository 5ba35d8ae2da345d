"""Volume rendering, its loss and its gradient against plain torch and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edge_server.fields.common.kernels.volume_rendering import (
    GUIDE_REACH,
    Weights,
    activate,
    add_harmonics,
    add_harmonics_backward,
    ray_loss,
    samples_until_opaque,
)
from tests.edge_server.fields import torch_model

SAMPLES = 24


def _ray(seed: int, density: float, sh_degree: int = 0):
    rng = np.random.default_rng(seed)
    rows = (4 + 9 * sh_degree + 3) // 4 * 4
    raw = rng.normal(size=(rows, SAMPLES)).astype(np.float32)
    raw[0] += np.float32(density)
    line = np.zeros((3, SAMPLES), np.float32)
    line[0] = 1.0 + np.arange(SAMPLES) * 0.05
    line[1] = rng.uniform(0.02, 0.08, SAMPLES)
    direction = rng.normal(size=3)
    direction = (direction / np.linalg.norm(direction)).astype(np.float32)
    ray = np.concatenate([direction, rng.random(6)]).astype(np.float32)
    return raw, line, ray


def _kernel(raw, line, ray, weights, sh_degree=0, guide=0.0):
    out, d_out = raw.copy(), np.zeros_like(raw)
    add_harmonics(out, sh_degree, 0, SAMPLES, *ray[:3])
    activate(out, 0, SAMPLES)
    error = ray_loss(out, d_out, line[0], line[1], line[2], 0, SAMPLES, ray[3:6], ray[6:9], np.float32(guide), weights)
    add_harmonics_backward(d_out, sh_degree, 0, SAMPLES, *ray[:3])
    return error, d_out


def _oracle(raw, line, ray, distortion, sh_degree=0):
    params = torch.as_tensor(raw.T.copy(), dtype=torch.float64).requires_grad_(True)
    direction = torch.as_tensor(ray[:3], dtype=torch.float64).expand(SAMPLES, 3)
    sigma, color = torch_model.shade(params, sh_degree, direction)
    t, delta = (torch.as_tensor(line[k], dtype=torch.float64)[None] for k in (0, 1))
    target, back = (torch.as_tensor(ray[a : a + 3], dtype=torch.float64)[None] for a in (3, 6))
    error, loss = torch_model.ray_losses(sigma[None], color[None], t, delta, target, back, distortion)
    return params, error, loss


@pytest.mark.parametrize("density", [-4.0, 3.0, 7.0])
@pytest.mark.parametrize("sh_degree", [0, 1])
def test_loss_and_gradient_equal_the_oracle(density: float, sh_degree: int) -> None:
    raw, line, ray = _ray(3, density, sh_degree)
    weights = Weights(np.float32(0.3))
    error, d_out = _kernel(raw, line, ray, weights, sh_degree)
    params, expected, loss = _oracle(raw, line, ray, 0.3, sh_degree)
    assert error == pytest.approx(expected.item(), rel=1e-4)
    loss.sum().backward()
    assert params.grad is not None
    np.testing.assert_allclose(d_out.T, params.grad.numpy(), atol=2e-5, rtol=2e-3)


@pytest.mark.parametrize("guide", [1.4, 0.2, 50.0])
def test_weight_away_from_a_guide_costs_what_geman_and_mcclure_say(guide: float) -> None:
    raw, line, ray = _ray(9, 1.0)
    weights = Weights(*np.float32([0.3, 0.7]))
    error, d_out = _kernel(raw, line, ray, weights, 0, guide)
    params, expected, loss = _oracle(raw, line, ray, 0.3)
    assert error == pytest.approx(expected.item(), rel=1e-4)  # the guide is no color
    sigma, _ = torch_model.shade(params, 0, torch.zeros(SAMPLES, 3, dtype=torch.float64))
    through = torch.exp(-torch.cumsum(sigma * torch.as_tensor(line[1], dtype=torch.float64), 0))
    before = torch.cat([torch.ones(1, dtype=torch.float64), through[:-1]])
    off = (torch.as_tensor(line[0], dtype=torch.float64) - guide) / (GUIDE_REACH * guide)
    away = ((before - through) * off**2 / (1 + off**2)).sum() + through[-1]
    (loss.sum() + 0.7 * away).backward()
    assert params.grad is not None
    np.testing.assert_allclose(d_out.T, params.grad.numpy(), atol=2e-5, rtol=2e-3)


def test_a_ray_ends_where_a_ten_thousandth_of_the_light_is_left() -> None:
    """Later, samples are evaluated for nothing; earlier, what is left out can be seen."""
    raw, line, ray = _ray(5, 0.0)
    line[1], raw[0] = 0.05, np.log(0.7 / 0.05)  # an optical depth of .7 a sample
    out = raw.copy()
    activate(out, 0, SAMPLES)
    through = np.exp(-np.cumsum(out[0].astype(np.float64) * line[1]))
    seen = samples_until_opaque(out, line[1], 0, SAMPLES)
    assert through[seen - 1] < 1e-4 < through[seen - 2]
    error, d_out = _kernel(raw, line, ray, Weights(np.float32(0)))
    weight = np.concatenate([[1.0], through[:-1]]) - through
    color = (weight * out[1:4]).sum(axis=1) + through[-1] * ray[6:9]
    assert error == pytest.approx(float(np.square(color - ray[3:6]).sum()), abs=3e-4)
    assert (d_out[0, seen:] == 0).all() and (d_out[0, :seen] != 0).all()


def test_clamped_density_and_what_is_not_finite_have_no_gradient() -> None:
    raw, line, ray = _ray(6, 0.0)
    raw[0, 0], raw[0, 1] = -40.0, -11.0
    _, d_out = _kernel(raw, line, ray, Weights(np.float32(0)))
    assert d_out[0, 0] == 0.0 and d_out[0, 1] != 0.0
    raw[0, 2] = 500.0  # overflows an unclamped exponential
    error, d_out = _kernel(raw, line, ray, Weights(np.float32(0)))
    assert np.isfinite(error) and error >= 0 and np.isfinite(d_out).all() and d_out[0, 2] == 0.0
    raw[2, 3] = np.inf  # full color
    assert np.isfinite(_kernel(raw, line, ray, Weights(np.float32(0.1)))[1]).all()
    raw[2, 3] = np.nan
    error, d_out = _kernel(raw, line, ray, Weights(np.float32(0.1)))
    assert error == -1.0 and (d_out == 0).all(), "a ray that is not finite is refused whole"
