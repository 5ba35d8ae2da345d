"""Pictures with samples from a proposal: every ray's compositing against plain torch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from msgspec import structs
from numpy.typing import NDArray

from edge_server.fields import Budget
from edge_server.fields.common.kernels.hash_grid import Grid
from edge_server.fields.common.kernels.render import BATCH, TILE, render_tiles
from edge_server.fields.common.ray_snapshot import RaySnapshot
from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.nerfacto.field import NerfactoField
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small_rays import TINY
from tests.edge_server.fields.torch_model import encode, mlp, ray_weights, shade, to_torch

VIEWS = ring(6, size=24)


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
    levels = snapshot.encoding
    grid = to_torch(Grid(levels.resolution, levels.first, levels.dense, levels.table), dtype=torch.float64)
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
