"""The torch implementation against the kernels: same pictures from the same state, and it learns alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget
from edge_server.fields.ngp import torch_field
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.torch_field import NgpTorchField, cuda_present
from edge_server.fields.ngp.torch_model import encode
from tests.edge_server.fields.ngp.small import SMALL
from tests.edge_server.fields.scenes import psnr, ring
from tests.edge_server.fields.small import HELD, SEEN


@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("harmonics", [1, 4])
def test_same_state_same_picture(contracted: bool, harmonics: int) -> None:
    settings = replace(SMALL, contracted=contracted, harmonics=harmonics)
    kernels, plain = NgpField(settings), NgpTorchField(settings, "cpu")
    kernels.fit(SEEN, Budget(steps=60))
    plain.load_state(kernels.state())
    a = kernels.render(HELD.camera_to_world, HELD.intrinsics)
    b = plain.render(HELD.camera_to_world, HELD.intrinsics)
    # Single samples at the borders of occupied cells may differ: float32 adds up in another order.
    assert psnr(a.color, b.color) > 50.0 and np.abs(a.opacity - b.opacity).mean() < 1e-3
    both = (a.opacity > 0.5) & (b.opacity > 0.5)
    assert both.mean() > 0.1 and np.abs(a.depth - b.depth)[both].mean() < 0.02


def test_states_travel_both_ways() -> None:
    a, b = NgpTorchField(SMALL, "cpu"), NgpField(SMALL)
    a.fit(SEEN[:5], Budget(steps=3))
    b.load_state(a.state())
    one, two = a.state(), b.state()
    for name in one.keys() - {"meta", "occupied"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
    assert b.fit(SEEN[:5], Budget(steps=2)).steps == 2


def test_it_learns_and_repeats_itself() -> None:
    views = ring(5, size=24)
    states = []
    for _ in range(2):
        field = NgpTorchField(replace(SMALL, rays=256, samples=32, levels=4, cells=16), "cpu")
        first = field.fit(views, Budget(steps=3))
        last = field.fit(views, Budget(steps=60))
        states.append(field.state())
        assert last.loss < 0.8 * first.loss and last.samples > 0
    np.testing.assert_array_equal(states[0]["table"], states[1]["table"])
    points, colors = field.points(50)
    assert len(points) == len(colors) > 5
    assert field.fit([], Budget(steps=1)).steps == 0


def test_stale_pixels_that_moved_are_not_drawn_and_old_ones_count_less() -> None:
    before, ms = ring(5, size=24), 10**6
    ball = np.array([0.3, 0.0, 0.5])
    after = [replace(v, generated_ns=k * 100 * ms) for k, v in enumerate(ring(5, size=24, ball_m=ball))]
    field = NgpTorchField(replace(SMALL, rays=2000, age_tau_ms=200.0, mask_stale_ms=150.0), "cpu")
    for views in (before, after):
        data = field.view_store.add(views).data
    o, _, target, _, weight = field._draw(data, np.random.default_rng(0))
    origins = data.origin.astype(np.float32)
    for k, view in enumerate(after):
        rows = np.flatnonzero((o.numpy() == origins[k]).all(axis=1))
        np.testing.assert_allclose(weight[rows].numpy(), np.exp(-100.0 * (4 - k) / 200.0), rtol=1e-5)
        moved = field.view_store.memory[view.camera].moved
        assert moved is not None and moved.any() and len(rows) > 50
        allowed = view.image[~moved] if k < 3 else view.image.reshape(-1, 3)
        colors = {tuple(c) for c in allowed.tolist()}
        assert all(tuple(c) in colors for c in np.round(target[rows].numpy() * 255).astype(int).tolist())
    assert 0 < len(data.drawn) < len(data.pixels)
    assert np.isfinite(field.fit(after, Budget(steps=2)).loss)


def test_warming_up_takes_a_step_of_a_field_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    points: list[int] = []
    monkeypatch.setattr(torch_field, "encode", lambda *a: points.append(len(a[2])) or encode(*a))
    field = NgpTorchField(SMALL, "cpu")
    assert field.warm_up() > 0.0 and max(points) > 0 and field.step == 0


def test_cuda_is_refused_where_there_is_none() -> None:
    if cuda_present():
        pytest.skip("this machine has a CUDA device")
    with pytest.raises(ValueError, match="torch finds none"):
        NgpTorchField(replace(SMALL, device="cuda"), "cuda")


@pytest.mark.skipif(not cuda_present(), reason="no CUDA device here")
def test_the_same_on_cuda() -> None:
    cpu, gpu = NgpTorchField(SMALL, "cpu"), NgpTorchField(SMALL, "cuda")
    gpu.warm_up()
    cpu.fit(SEEN, Budget(steps=20))
    gpu.load_state(cpu.state())
    a, b = (f.render(HELD.camera_to_world, HELD.intrinsics).color for f in (cpu, gpu))
    assert psnr(a, b) > 40.0
    assert gpu.fit(SEEN, Budget(steps=20)).loss < 0.05
