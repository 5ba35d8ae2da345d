"""A scan: a camera walks around a small scene, with depth, wrong poses and a changing exposure."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray

from edge_server.experiments.fitting.misfits import misfits
from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, RefinesCameras, View
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.splat.carried_camera import scan_field
from edge_server.fields.splat.carried_camera.frame_stereo import sweep_depth
from edge_server.fields.splat.carried_camera.scan_field import ScanField
from edge_server.fields.splat.densification import opacity
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import se3, so3_exp
from tests.edge_server.fields.scenes import BALL_M, RADIUS_M
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.carried_camera.carried import WALK, spoiled, walk

Spoil = Callable[[list[View]], list[View]]
WITH_DEPTH, WITHOUT = WALK, walk(depth=False)
HELD = slice(4, None, 8)


def _settings(threads: int = 2, refine: bool = True) -> SplatSettings:
    sizes = {"gaussians": 3000, "start": 500, "seed_cells": 32}
    return SplatSettings(**sizes, scan=True, refine=refine, threads=threads, contracted=False)


def _split(views: list[View]) -> tuple[list[View], list[View]]:
    held = views[HELD]
    return [view for view in views if all(view is not other for other in held)], held


def _fit(views: list[View], steps: int = 300, refine: bool = False) -> tuple[ScanField, float, float | None]:
    """The field, and PSNR of what is held out: as given, and refined."""
    training, held = _split(views)
    field = ScanField(_settings(refine=refine))
    field.fit(training, Budget(steps=steps))
    score, _ = score_views(field, held, Scorer())
    return field, score.psnr_db, score.psnr_refined_db


@pytest.mark.parametrize("footage", [WITH_DEPTH, WITHOUT])
def test_it_learns_with_measured_depth_and_without(footage: list[View]) -> None:
    field, psnr_db, refined_db = _fit(footage)
    assert psnr_db > 22.5 and refined_db is None and isinstance(field, RefinesCameras)
    assert len(field.cloud) <= 3000 and field.correction(WALK[0]) is None


@pytest.mark.parametrize("place_m", [(0.0, 0.0, 0.0), (500_000.0, 5_000_000.0, 0.0)])  # the second is of a map
def test_first_gaussians_lie_on_measured_depth(place_m: tuple[float, ...]) -> None:
    field, place = ScanField(_settings(refine=False)), se3(np.eye(3), place_m)
    field.fit([replace(view, camera_to_world=place @ view.camera_to_world) for view in WALK], Budget(steps=0))
    box = field.view_store.box
    assert box is not None
    measured = field.cloud.params[opacity(field.cloud.params) > 0.7]  # the others stand for the sky
    at = measured[:, :3] * box.radius_m + np.asarray(box.center_m) - place_m
    from_ball, from_ground = np.linalg.norm(at - BALL_M, axis=1) - RADIUS_M, at[:, 2]
    near = np.minimum(np.abs(from_ball), np.abs(from_ground)) < 0.05
    assert len(near) > 50 and near.mean() > 0.9


def test_pixels_of_no_weight_or_that_show_nothing_do_not_supervise() -> None:
    shown = np.dstack([WALK[0].image[..., :3], np.full(WALK[0].image.shape[:2], 255, np.uint8)])
    weight = np.ones(shown.shape[:2], np.float32)
    shown[:4, :, 3], weight[:, :6] = 0, 0.0
    color, there = ScanField(_settings())._as_rendered(replace(WALK[0], image=shown, weight=weight))
    assert there[4:, 6:].all() and there.sum() == there[4:, 6:].size
    np.testing.assert_allclose(color, WALK[0].image[..., :3] / 255, atol=1e-6)


def test_views_are_swept_until_further_ones_show_hardly_anything_new(monkeypatch: pytest.MonkeyPatch) -> None:
    """Spread ones first. To sweep all of them took two seconds before the first step of a fit."""
    swept: list[int] = []

    def noted(view: View, others: Sequence[View], distance_m: float, pool: Pool) -> NDArray[np.float32] | None:
        swept.append(int(view.camera))
        return sweep_depth(view, others, distance_m, pool)

    monkeypatch.setattr(scan_field, "sweep_depth", noted)
    field = ScanField(_settings(refine=False))
    field.fit(WITHOUT, Budget(steps=0))
    assert swept[:4] == [0, 40, 20, 60] and 8 <= len(swept) < 20
    assert field._seen_m == pytest.approx(2.07, abs=0.1)
    swept.clear()
    ScanField(structs.replace(_settings(refine=False), gaussians=200)).fit(WITHOUT, Budget(steps=0))
    assert len(swept) < 8, "there is no room for more"
    for count in range(70):
        assert sorted(scan_field._spread_first(count)) == list(range(count))


def test_where_poses_tell_no_depth_first_gaussians_lie_where_colors_agree() -> None:
    turns = [se3(so3_exp(np.deg2rad([0.0, 5.0 * k, 0.0])), np.zeros(3)) for k in range(8)]
    turned = [replace(v, camera_to_world=WITHOUT[0].camera_to_world @ t) for v, t in zip(WITHOUT, turns)]
    for views in (WITHOUT[:1], turned):
        field = ScanField(_settings(refine=False))
        field.fit(views, Budget(steps=0))
        assert len(field.cloud) > 0 and field._seen_m == 0.0


def test_poses_and_exposures_are_refined_and_held_out_frames_take_their_neighbors() -> None:
    footage = spoiled(WALK)
    plain_db = _fit(footage)[1]
    field, raw_db, refined_db = _fit(footage, refine=True)
    assert refined_db is not None and refined_db > plain_db + 4.0 and refined_db > raw_db + 4.0
    held = _split(footage)[1][1]
    one, dark = (field.correction(view) for view in (held, replace(held, image=np.zeros_like(held.image))))
    assert one is not None and dark is not None
    np.testing.assert_array_equal(one.camera_to_world, dark.camera_to_world)  # the image is not looked at
    np.testing.assert_array_equal(one.gain, dark.gain)


@pytest.mark.slow
def test_exact_poses_are_hardly_spoiled_however_long_they_are_refined() -> None:
    """With steps that never get shorter they lose 2 dB."""
    plain_db, refined_db = _fit(WALK, 1200)[1], _fit(WALK, 1200, refine=True)[2]
    assert refined_db is not None and refined_db > plain_db - 0.3


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
