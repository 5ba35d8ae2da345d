"""A scan: a camera walks around a small scene, with depth, wrong poses and a changing exposure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from edge_server.experiments.fitting.misfits import misfits
from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, RefinesCameras, View
from edge_server.fields.splat.carried_camera import scan_field
from edge_server.fields.splat.carried_camera.scan_field import ScanField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.carried_camera.carried import WALK, walk

Spoil = Callable[[list[View]], list[View]]
WITH_DEPTH, WITHOUT = WALK, walk(depth=False)


def _settings(refine: bool = True) -> SplatSettings:
    sizes = {"gaussians": 3000, "start": 500, "seed_cells": 32}
    return SplatSettings(**sizes, scan=True, refine=refine, threads=2, contracted=False)


@pytest.mark.parametrize("footage", [WITH_DEPTH, WITHOUT])
def test_it_learns_with_measured_depth_and_without(footage: list[View]) -> None:
    field = ScanField(_settings(refine=False))
    field.fit([view for k, view in enumerate(footage) if k % 8 != 4], Budget(steps=300))
    score, _ = score_views(field, footage[4::8], Scorer())
    assert score.psnr_db > 22.5 and score.psnr_refined_db is None and isinstance(field, RefinesCameras)
    assert len(field.cloud) <= 3000 and field.correction(WALK[0]) is None


def test_views_are_swept_until_further_ones_show_hardly_anything_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spread ones first. To sweep all of them took two seconds before the first step of a fit."""
    swept: list[int] = []
    sweep = scan_field.sweep_depth
    monkeypatch.setattr(
        scan_field, "sweep_depth", lambda view, *rest: swept.append(int(view.camera)) or sweep(view, *rest)
    )
    field = ScanField(_settings(refine=False))
    field.fit(WITHOUT, Budget(steps=0))
    assert swept[:4] == [0, 40, 20, 60] and 8 <= len(swept) < 20
    assert field._seen_m == pytest.approx(2.07, abs=0.1)
    swept.clear()
    ScanField(structs.replace(_settings(refine=False), gaussians=200)).fit(WITHOUT, Budget(steps=0))
    assert len(swept) < 8, "there is no room for more"
    for count in range(70):
        assert sorted(scan_field._spread_first(count)) == list(range(count))
    alone = ScanField(_settings(refine=False))
    alone.fit(WITHOUT[:1], Budget(steps=0))
    assert len(alone.cloud) > 0 and alone._seen_m == 0.0, "without depth, Gaussians are where colors agree"


def _jumping_exposures(views: list[View]) -> list[View]:
    scale = [1.0, 3.0, 1.0 / 3.0]
    images = [np.clip(view.image * (0.33 * scale[k % 3]), 0, 255).astype(np.uint8) for k, view in enumerate(views)]
    return [replace(view, image=image) for view, image in zip(views, images)]


def _leap(views: list[View]) -> list[View]:
    wrong = views[10].camera_to_world.copy()
    wrong[:3, 3] += (0.7, -0.5, 0.5)
    return [*views[:10], replace(views[10], camera_to_world=wrong), *views[11:]]


def _senseless_depth(views: list[View]) -> list[View]:
    rng = np.random.default_rng(0)
    noise = [rng.choice(np.array([0.0, 1e-3, 2.0, 1e4], np.float32), view.image.shape[:2]) for view in views]
    return [replace(view, depth=depth) for view, depth in zip(views, noise)]


def _another_camera(views: list[View]) -> list[View]:
    other = np.random.default_rng(1).integers(0, 255, views[10].image.shape, np.uint8)
    return [*views[:10], replace(views[10], image=other), *views[11:]]


@pytest.mark.stability
@pytest.mark.parametrize(
    ("spoil", "footage", "least_db"),
    [
        (_another_camera, WITHOUT, 20.5),
        (_jumping_exposures, WITHOUT, 21.0),
        (_jumping_exposures, WITH_DEPTH, 17.0),
        (_leap, WITH_DEPTH, 17.0),
        (_senseless_depth, WITH_DEPTH, 17.0),
    ],
)
def test_hard_footage_leaves_a_finite_field_that_shows_what_it_learned(spoil, footage, least_db) -> None:
    """least_db: of frames that were learned, at their corrections. ``test_carried_field`` has what else befalls one."""
    footage = spoil(footage[::2])
    field = ScanField(_settings())
    field.fit(footage, Budget(steps=200))
    state = field.state()
    for name in ("params", "m", "v"):
        assert np.isfinite(state[name]).all(), name
    for known in field._poses.known.values():
        assert np.linalg.norm(known.shift_m) <= field._poses.most_m + 1e-9
    refined_db = score_views(field, footage[::9], Scorer())[0].psnr_refined_db
    assert refined_db is not None and refined_db > least_db
    field.reset()
    same_state(field, ScanField(_settings()))  # what comes afterwards is learned as ever


@pytest.mark.stability
@pytest.mark.parametrize(("spoil", "named"), [(_leap, ["020"]), (_another_camera, ["020"]), (list, [])])
def test_a_frame_that_does_not_fit_is_named(spoil: Spoil, named: list[str]) -> None:
    footage = spoil(WALK[::2])
    field = ScanField(_settings())
    field.fit(footage, Budget(steps=200))
    lines = misfits(field, footage, Scorer())
    assert [line.split(":")[0] for line in lines] == [f"frame {name}" for name in named]
