"""What is the proposal-sampled field's own: sampling, appearances, and every ray's compositing against plain torch."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs
from numpy.typing import NDArray

from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget
from edge_server.fields.common.kernels.render import BATCH, TILE, render_tiles
from edge_server.fields.common.ray_snapshot import RaySnapshot
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.nerfacto.field import NerfactoField
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import SMALL, TINY, score
from tests.edge_server.fields.torch_model import encode, mlp, ray_weights, shade, to_torch

VIEWS = ring(6, size=24)


def test_samples_are_uniform_at_first_and_then_follow_the_proposal() -> None:
    field = NerfactoField(structs.replace(SMALL["nerfacto"], even=0.4, anneal=40))
    for step, share in ((0, 1.0), (10, 0.85), (40, 0.4), (400, 0.4)):
        field.step = step
        assert field._sampling().uniform_share == pytest.approx(share)
    assert NerfactoField(structs.replace(SMALL["nerfacto"], interlevel=0.0))._sampling().uniform_share == 1.0


def test_appearances_take_up_what_differs_between_cameras() -> None:
    """A room's pictures with gains of 0.7 to 1.4; scored against the picture at the mean exposure."""
    still = synthetic_still("room", cameras=13, size=48)
    gains = np.exp(np.random.default_rng(2).permutation(np.linspace(-0.35, 0.35, 12)))
    views = [
        replace(v, image=np.clip(v.image * g + 0.5, 0, 255).astype(np.uint8)) for v, g in zip(still.training, gains)
    ]
    scores, looks = [], None
    for appearance in (0, 4):
        field = NerfactoField(structs.replace(SMALL["nerfacto"], appearance=appearance))
        field.fit(views, Budget(steps=300))
        scores.append(score(field, still.held_out[0]))
        looks = field._cameras.appearances
    assert scores[1] > scores[0] + 1.0
    assert looks is not None and set(looks.known) == {v.camera for v in views}
    values = np.array([known[0] for known in looks.known.values()])
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-9)


@pytest.fixture(scope="module")
def snapshot() -> Any:
    settings = structs.replace(TINY["nerfacto"], samples=16, anneal=20, sh_degree=1, threads=1)
    field = NerfactoField(settings, CallerPool())
    field.fit(VIEWS, Budget(steps=60))
    return field.snapshot()


def _render(
    snapshot: RaySnapshot, pixels: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Places (N, 3), distances and lengths (2, N) of the samples that stay in the scratch; RGBDA (P, 5)."""
    view, n = VIEWS[2], len(pixels)
    x, line = (np.full((1, 3, BATCH), np.nan, np.float32) for _ in range(2))
    out = np.full((n, 3), np.nan, np.float32), np.full(n, np.nan, np.float32), np.full(n, np.nan, np.float32)
    lens, rotation = np.array(lens_row(view.intrinsics)), view.camera_to_world[:3, :3].copy()
    camera = lens, rotation, snapshot.box.normalise(view.camera_to_world[:3, 3])
    model = snapshot.encoding, snapshot.levels, snapshot.net
    scratch = np.empty((1, int(snapshot.net.widths.sum()), BATCH), np.float32), x, line
    degree = snapshot.settings.sh_degree
    CallerPool().run(render_tiles, camera, pixels, snapshot.space, model, degree, snapshot.background, scratch, out)
    here = np.isfinite(x[0, 0])
    return x[0][:, here].T, line[0, 0, here], line[0, 1, here], np.column_stack(out)


def test_a_ray_is_what_torch_makes_of_its_samples(snapshot: RaySnapshot) -> None:
    view, solid = VIEWS[2], []
    grid = to_torch(snapshot.encoding)
    params = torch.as_tensor(snapshot.net.params, dtype=torch.float64)
    for pixel in np.random.default_rng(0).uniform(0.0, 24.0, (40, 2)):
        places, t, delta, rendered = _render(snapshot, pixel[None])
        assert len(places) <= 2 * snapshot.settings.samples + 1 and (np.diff(t) > 0).all()
        way = (view.intrinsics.rays(pixel[None]) @ view.camera_to_world[:3, :3].T).repeat(len(places), axis=0)
        way /= np.linalg.norm(way, axis=-1, keepdims=True)
        at, d = torch.as_tensor(places, dtype=torch.float64), torch.as_tensor(way, dtype=torch.float64)
        raw = mlp(snapshot.net.widths.tolist(), params, encode(grid, snapshot.levels, at))
        sigma, color = shade(raw, snapshot.settings.sh_degree, d)
        weight, left = ray_weights(sigma[None], torch.as_tensor(delta, dtype=torch.float64)[None])
        back = torch.as_tensor(snapshot.background, dtype=torch.float64)
        expected = (weight[0, :, None] * color).sum(dim=0) + left[0] * back
        np.testing.assert_allclose(rendered[0, :3], expected.clamp(0.0, 1.0).numpy(), atol=2e-5)
        opacity = float(weight.sum())
        assert rendered[0, 4] == pytest.approx(opacity, abs=1e-5)
        away = float((weight[0] * torch.as_tensor(t)).sum()) / opacity if opacity > 1e-3 else 0.0
        assert rendered[0, 3] == pytest.approx(away, rel=1e-3, abs=1e-5)
        solid.append(opacity)
    assert np.ptp(solid) > 0.5, "the pixels must show full and empty space"
    # Rays do not depend on those beside them: more than one task holds, and more samples than there is room for.
    pixels = np.random.default_rng(1).uniform(0.0, 24.0, (TILE + 30, 2))
    assert TILE * snapshot.settings.samples >= 2 * BATCH
    alone = np.concatenate([_render(snapshot, p[None])[-1] for p in pixels])
    np.testing.assert_allclose(_render(snapshot, pixels)[-1], alone, atol=1e-6)
