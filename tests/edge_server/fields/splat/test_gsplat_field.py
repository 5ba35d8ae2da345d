"""The gsplat field's own code, with the torch oracle in place of gsplat, which needs a GPU."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from edge_server.fields import Budget
from edge_server.fields.registry import make_field
from edge_server.fields.splat import gsplat_field
from edge_server.fields.splat.field import SplatField
from edge_server.fields.splat.gsplat_field import GsplatField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.splat.torch_oracle import Flat, composite, rotations

TINY = SplatSettings(gaussians=40, start=24, seed_cells=16, densify_every=6, threads=1, changed_share=0.0)
VIEWS = ring(4, size=16)


def rasterize(
    *,
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float,
    backgrounds: Tensor,
    packed: bool,
) -> tuple[Tensor, Tensor, dict[str, Any]]:
    """gsplat's ``rasterization`` for one camera, made of the oracle's parts."""
    assert not packed and len(viewmats) == len(Ks) == len(backgrounds) == 1
    view, k = viewmats[0], Ks[0]
    x, y, z = (means @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    seen = z > near_plane
    z = torch.where(seen, z, torch.ones_like(z))
    none = torch.zeros_like(z)
    mean = torch.stack([k[0, 0] * x / z + k[0, 2], k[1, 1] * y / z + k[1, 2]], dim=-1)
    plane = torch.stack([k[0, 0] / z, none, -k[0, 0] * x / z**2, none, k[1, 1] / z, -k[1, 1] * y / z**2], dim=-1).view(
        -1, 2, 3
    )
    half = plane @ view[:3, :3] @ rotations(quats) * scales[:, None, :]
    covariance = half @ half.mT + 0.3 * torch.eye(2)
    color, _, opacity = composite(Flat(mean, covariance, opacities, colors, z, seen), width, height, backgrounds[0])
    radii = 3.0 * covariance.detach().diagonal(dim1=1, dim2=2).amax(-1).sqrt() * seen
    return color[None], opacity[None, ..., None], {"means2d": mean[None], "radii": radii.ceil().int()[None]}


@pytest.mark.parametrize("harmonics", [1, 4])
def test_its_steps_are_those_of_the_kernels(harmonics: int) -> None:
    settings = replace(TINY, harmonics=harmonics, epsilon=1.0)  # or signs of tiny gradients decide
    cpu, cuda = SplatField(settings), GsplatField(settings, rasterize, "cpu")
    for field in (cpu, cuda):
        report = field.fit(VIEWS, Budget(steps=4))
        assert report.dropped == 0 and report.loss > 0
    assert len(cpu.cloud) == len(cuda.cloud) and np.abs(cpu.cloud.m).max() > 0
    np.testing.assert_allclose(cpu.cloud.params, cuda.cloud.params, atol=2e-2)
    close = np.abs(cpu.cloud.params - cuda.cloud.params) < 1e-3
    assert close.mean() > 0.95


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device here")
@pytest.mark.parametrize("harmonics", [1, 4])
def test_on_a_gpu_its_steps_are_those_of_the_kernels(harmonics: int) -> None:
    settings = replace(TINY, harmonics=harmonics, epsilon=1.0)
    cpu, cuda = SplatField(settings), gsplat_field.make_cuda(settings)
    losses = [field.fit(VIEWS, Budget(steps=4)).loss for field in (cpu, cuda)]
    assert losses[0] == pytest.approx(losses[1], rel=0.02)
    assert len(cpu.cloud) == len(cuda.cloud)
    close = np.abs(cpu.cloud.params - cuda.cloud.params) < 1e-3
    assert close.mean() > 0.95


def test_it_weighs_pixels_as_the_kernels_do() -> None:
    views = [replace(v, generated_ns=-k * 10**8) for k, v in enumerate(VIEWS)]
    moments = []
    for tau_ms in (0.0, 100.0):
        settings = replace(TINY, start=8, age_tau_ms=tau_ms, epsilon=1.0)
        cpu, cuda = SplatField(settings), GsplatField(settings, rasterize, "cpu")
        losses = [field.fit(views, Budget(steps=2)).loss for field in (cpu, cuda)]
        assert losses[0] == pytest.approx(losses[1], rel=0.02)
        moments.append(np.abs(cpu.cloud.m).sum())
        assert np.abs(cuda.cloud.m).sum() == pytest.approx(moments[-1], rel=0.05)
    assert moments[1] < 0.7 * moments[0]


@pytest.mark.parametrize("placed", [{}, {"near_m": 5.0}, {"centre_m": (5.0, 0.0, 0.0), "radius_m": 0.5}])
def test_warming_up_reaches_the_rasterizer(placed: dict[str, Any]) -> None:
    calls: list[Any] = []
    field = GsplatField(replace(TINY, **placed), lambda **k: calls.append(k) or rasterize(**k), "cpu")
    assert field.warm_up() > 0.0 and calls and field.step == 0


def test_no_gaussians_are_not_rasterized() -> None:
    field = GsplatField(replace(TINY, min_views=1), lambda **_: pytest.fail("gsplat ends the process"), "cpu")
    gray = replace(VIEWS[0], image=np.full_like(VIEWS[0].image, 128))
    report = field.fit([gray], Budget(steps=2))
    assert len(field.cloud) == 0 and report.steps == 2 and report.dropped == 0


def test_it_grows_saves_and_resumes_on_the_cpu() -> None:
    cuda = GsplatField(TINY, rasterize, "cpu")
    cuda.fit(VIEWS, Budget(steps=14))
    assert 24 < len(cuda.cloud) <= 40
    cpu = SplatField(TINY)
    cpu.load_state(cuda.state())
    a, b = (f.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics).color for f in (cpu, cuda))
    np.testing.assert_array_equal(a, b)


def test_unsupported_cameras_and_losses_are_refused() -> None:
    bent = replace(VIEWS[0].intrinsics, distortion=(0.01, 0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match="pinhole cameras only"):
        GsplatField(TINY, rasterize, "cpu").fit([replace(VIEWS[0], intrinsics=bent)], Budget(steps=1))
    with pytest.raises(ValueError, match="dssim"):
        GsplatField(replace(TINY, dssim=0.2), rasterize, "cpu")


def test_without_a_gpu_or_gsplat_the_error_says_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(ValueError, match="no CUDA device"):
        make_field("splat", {"device": "cuda"})
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setitem(sys.modules, "gsplat", None)  # as where it is not installed
    with pytest.raises(ValueError, match=r"freshfield\[cuda\]"):
        gsplat_field.make_cuda(TINY)
