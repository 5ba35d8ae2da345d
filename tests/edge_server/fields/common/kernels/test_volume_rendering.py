"""Volume rendering, its loss and its gradient against plain torch and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edge_server.fields.common.kernels.volume_rendering import (
    GUIDE_REACH,
    Weights,
    activate,
    ray_loss,
    samples_until_opaque,
)
from tests.edge_server.fields import torch_model

SAMPLES = 24


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
    activate(out, 0, SAMPLES)
    error = ray_loss(out, d_out, *line, 0, SAMPLES, ray[:3], ray[3:], np.float32(guide), weights)
    return error, d_out


@pytest.mark.parametrize(("density", "guide"), [(1.0, 1.4), (-4.0, 50.0)])
def test_weight_away_from_a_guide_costs_what_geman_and_mcclure_say(density: float, guide: float) -> None:
    raw, line, ray = _ray(9, density)
    error, d_out = _kernel(raw, line, ray, Weights(*np.float32([0.3, 0.7])), guide)
    params = torch.as_tensor(raw.T.copy(), dtype=torch.float64).requires_grad_(True)
    sigma, color = torch_model.shade(params, 0, torch.zeros(SAMPLES, 3, dtype=torch.float64))
    t, delta = (torch.as_tensor(line[k], dtype=torch.float64) for k in (0, 1))
    target, back = (torch.as_tensor(ray[a : a + 3], dtype=torch.float64)[None] for a in (0, 3))
    expected, loss = torch_model.ray_losses(sigma[None], color[None], t[None], delta[None], target, back, 0.3)
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
    activate(out, 0, SAMPLES)
    through = np.exp(-np.cumsum(out[0].astype(np.float64) * line[1]))
    seen = samples_until_opaque(out, line[1], 0, SAMPLES)
    assert through[seen - 1] < 1e-4 < through[seen - 2]
    error, d_out = _kernel(raw, line, ray, Weights(np.float32(0)))
    weight = np.concatenate([[1.0], through[:-1]]) - through
    color = (weight * out[1:4]).sum(axis=1) + through[-1] * ray[3:]
    assert error == pytest.approx(float(np.square(color - ray[:3]).sum()), abs=3e-4)
    assert (d_out[0, seen:] == 0).all() and (d_out[0, :seen] != 0).all()


def test_clamped_density_and_what_is_not_finite_have_no_gradient() -> None:
    raw, line, ray = _ray(6, 0.0)
    raw[0, 0], raw[0, 1] = -40.0, -11.0
    _, d_out = _kernel(raw, line, ray, Weights(np.float32(0)))
    assert d_out[0, 0] == 0.0 and d_out[0, 1] != 0.0
    raw[0, 2] = 500.0  # overflows an unclamped exponential
    error, d_out = _kernel(raw, line, ray, Weights(np.float32(0)))
    assert np.isfinite(error) and error >= 0 and np.isfinite(d_out).all() and d_out[0, 2] == 0.0
    raw[2, 1] = np.inf  # full color
    assert np.isfinite(_kernel(raw, line, ray, Weights(np.float32(0.1)))[1]).all()
    raw[2, 1] = np.nan
    error, d_out = _kernel(raw, line, ray, Weights(np.float32(0.1)))
    assert error == -1.0 and (d_out == 0).all(), "a ray that is not finite is refused whole"
