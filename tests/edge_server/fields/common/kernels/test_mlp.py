"""The network's forward and backward against plain torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from edge_server.fields.common.kernels.mlp import Net, backward, forward, param_count
from tests.edge_server.fields import torch_model


@pytest.mark.parametrize("widths", [[16, 32, 4], [8, 16, 16, 12]])
@pytest.mark.parametrize("samples", [1, 300])
def test_forward_and_backward_equal_the_oracle(widths: list[int], samples: int) -> None:
    rng = np.random.default_rng(2)
    sizes = np.array(widths, dtype=np.int64)
    net = Net(sizes, (rng.normal(size=param_count(sizes)) * 0.4).astype(np.float32))
    acts = np.zeros((sum(widths), samples + 5), np.float32)
    acts[: widths[0]] = rng.normal(size=(widths[0], samples + 5))
    d_acts = np.zeros_like(acts)
    d_acts[-widths[-1] :] = rng.normal(size=(widths[-1], samples + 5))
    d_params = np.zeros_like(net.params)
    forward(net, acts, 0, samples)
    x = torch.as_tensor(acts[: widths[0], :samples].T.copy()).requires_grad_(True)
    params = torch.as_tensor(net.params).clone().requires_grad_(True)
    out = torch_model.mlp(widths, params, x)
    np.testing.assert_allclose(acts[-widths[-1] :, :samples].T, out.detach().numpy(), atol=1e-5)
    assert (acts[-widths[-1] :, samples:] == 0).all()
    backward(net, acts, d_acts, samples, d_params)
    (out * torch.as_tensor(d_acts[-widths[-1] :, :samples].T.copy())).sum().backward()
    assert x.grad is not None and params.grad is not None
    np.testing.assert_allclose(d_acts[: widths[0], :samples].T, x.grad.numpy(), atol=1e-5)
    np.testing.assert_allclose(d_params, params.grad.numpy(), atol=3e-4, rtol=1e-4)
