"""The Fisher information of our Gaussians against derivatives by torch, and the selector that uses it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from edge_server.fields import View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.kernels.project import BASE
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.viewpoints.candidates import half_hemisphere
from edge_server.viewpoints.fisher import FisherRF, information
from edge_server.viewpoints.registry import CaptureState
from freshfield.geometry import Pinhole, look_at
from tests.edge_server.fields.splat import torch_oracle
from tests.edge_server.fields.splat.kernels.small_cloud import BOX, as_gaussians, random_params

LENS = Pinhole(9, 7, 9.0, 9.5, 4.3, 3.6)
BENT = replace(LENS, distortion=(-0.12, 0.03, 0.01, -0.015))
BACK = np.array([0.2, 0.5, 0.9], np.float32)
POSES = [look_at(eye, (0.05, 0.0, 0.1)) for eye in ((1.0, -2.5, 0.8), (-0.4, -1.2, 2.0))]


def snapshot(params, threads=1):
    return SplatSnapshot(BOX, as_gaussians(params), BACK, Pool(threads, 0), 1)


def oracle(params, pose, lens):
    """Sum over pixels and colors of squared derivatives, one backward pass a color of a pixel."""
    wanted = torch.tensor(params, dtype=torch.float64, requires_grad=True)
    cam = torch.as_tensor(camera_rows([pose], [lens], BOX)[0], dtype=torch.float64)
    flat = torch_oracle.flatten(cam, wanted, 0)
    back = torch.as_tensor(BACK, dtype=torch.float64)
    color = torch_oracle.composite(flat, lens.width, lens.height, back)[0]
    total = torch.zeros_like(wanted)
    for value in color.ravel():
        total += torch.autograd.grad(value, wanted, retain_graph=True)[0] ** 2
    return total.numpy()


@pytest.mark.parametrize("lens", [LENS, BENT])
def test_information_is_the_sum_of_squared_derivatives(lens):
    params = random_params(6, seed=4)
    params[5, :3] = (0.0, 0.0, 500.0)  # outside all pictures
    for pose, found in zip(POSES, information(snapshot(params), POSES, [lens] * 2), strict=True):
        exact = oracle(params, pose, lens)
        np.testing.assert_allclose(found, exact, rtol=1e-4, atol=1e-5 * exact.max())
        assert not found[5].any() and found[:5].any(axis=1).all()


def test_information_is_the_same_whatever_the_threads_and_the_batch():
    params, many = random_params(300), [look_at((np.cos(a), -2.0, np.sin(a)), (0, 0, 0)) for a in range(11)]
    one = list(information(snapshot(params), many, [LENS] * 11))
    two = list(information(snapshot(params, 2), many[::-1], [LENS] * 11))[::-1]
    np.testing.assert_array_equal(one, two)


def test_fisher_prefers_what_was_not_seen():
    """Gaussians left and right; the left ones were seen: a view of the right ones is worth more."""
    params = random_params(200)
    params[:, :3] = np.random.default_rng(1).normal(0.0, 0.1, (200, 3))
    params[:100, 0] -= 1.0
    params[100:, 0] += 1.0
    narrow = Pinhole.from_fov(16, 16, 20.0)
    candidates = half_hemisphere((0, 0, 0), 2.5, narrow, 2)
    poses = np.stack([look_at((x, -2.5, 0.6), (x, 0, 0)) for x in (-1.0, 1.0)])
    known = type("Known", (), {"snapshot": lambda self: snapshot(params)})()
    left = View("left", np.zeros((16, 16, 3), np.uint8), poses[0], narrow)
    state = CaptureState(
        replace(candidates, poses=poses), 2, np.random.default_rng(0), lambda views: known, [0], [left]
    )
    state.open[:] = True
    values = FisherRF().values(state)
    assert values[1] > 2.0 * values[0] > 0.0 and params.shape[1] == BASE
