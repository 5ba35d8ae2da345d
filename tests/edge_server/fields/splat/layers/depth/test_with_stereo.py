"""The field in layers where few cameras measure no depth: stereo of their plates takes its place."""

from __future__ import annotations

import logging
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.splat.layers import settings as layer_settings
from edge_server.fields.splat.layers.layered_field import LayeredField
from tests.edge_server.fields.scenes import psnr, ring
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.layers.depth.moving_ball import FRAME_S, SMALL, score, taken

RIG = ring(9, 64)
CAMERAS, HELD = [RIG[0], RIG[1], RIG[3]], RIG[2]
FRAMES = 36
pytestmark = pytest.mark.usefixtures("shown_soon")


@cache
def _frame(camera: int, frame: int) -> View:
    return replace(taken(CAMERAS[camera], (frame + camera / len(CAMERAS)) * FRAME_S), depth=None)


def _run(field: LayeredField, frames: range, cameras: int = 3, steps: int = 20) -> None:
    for frame in frames:
        field.fit([_frame(k, frame) for k in range(cameras)], Budget(steps=steps))


def _score(field: LayeredField) -> float:
    return score(field, HELD, (FRAMES - 1) * FRAME_S)


def test_stereo_shows_what_is_between_few_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = []
    monkeypatch.setattr(layer_settings, "PLAIN_CAMERAS", 0)
    for most in (0, layer_settings.STEREO_CAMERAS):
        monkeypatch.setattr(layer_settings, "STEREO_CAMERAS", most)
        field = LayeredField(SMALL)
        _run(field, range(FRAMES))
        assert field.supervision.with_depth == (most > 0)
        scores.append(_score(field))
    assert scores[1] > scores[0] + 1.0


@pytest.mark.parametrize(("plain_rows", "plain"), [(0, False), (14, True), (64, False)])
def test_with_more_cameras_stereo_is_used_where_some_of_the_plates_is_plain(
    plain_rows: int, plain: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the images the uppermost rows show a plain sky, which the others would, too, but for a grain."""
    monkeypatch.setattr(layer_settings, "STEREO_CAMERAS", 2)
    monkeypatch.setattr(layer_settings, "PLAIN_CAMERAS", 3)
    grain = np.random.default_rng(0).integers(-12, 13, CAMERAS[0].image.shape)
    grain[:plain_rows] = 0
    field = LayeredField(SMALL)
    for frame in range(24):
        views = [_frame(k, frame) for k in range(3)]
        grained = [replace(v, image=np.clip(v.image + grain, 0, 255).astype(np.uint8)) for v in views]
        field.fit(grained, Budget(steps=5))
    assert field.supervision.plain == plain and field.supervision.with_depth == plain
    stereo = field.supervision.depth is not None and field.supervision.depth.stereo is not None
    assert stereo == plain
    again = LayeredField(SMALL)
    again.load_state(field.state())
    assert again.supervision.plain == plain


def test_it_resumes_bit_for_bit() -> None:
    field, other = LayeredField(SMALL), LayeredField(SMALL)
    _run(field, range(20), steps=5)
    assert field.supervision.with_depth
    other.load_state(field.state())
    for each in (field, other):
        _run(each, range(20, 26), steps=5)
    same_state(field, other)


def test_with_a_budget_in_seconds_it_is_found_beside() -> None:
    field = LayeredField(SMALL)
    for frame in range(20):
        field.fit([_frame(k, frame) for k in range(3)], Budget(seconds=0.02))
    while field.static.training and not field.static.ready:
        field.fit([_frame(k, 20) for k in range(3)], Budget(seconds=0.02))
    assert field.static.ready and len(field.still.views) > 3
    field.static.stop()


def test_one_camera_alone_is_told_what_it_cannot_do(caplog: pytest.LogCaptureFixture) -> None:
    field = LayeredField(SMALL)
    with caplog.at_level(logging.WARNING):
        _run(field, range(20), cameras=1, steps=1)
    assert field.tracker is None and caplog.text.count("tells no depth") == 1


@cache
def _usual() -> float:
    field = LayeredField(SMALL)
    _run(field, range(FRAMES))
    return _score(field)


@pytest.mark.stability
@pytest.mark.parametrize("unit", [1.0 / 3.0, 2.0])
def test_other_units_cost_little(unit: float) -> None:
    def scaled(view: View) -> View:
        pose = view.camera_to_world.copy()
        pose[:3, 3] *= unit
        return replace(view, camera_to_world=pose)

    field = LayeredField(SMALL)
    for frame in range(FRAMES):
        field.fit([scaled(_frame(k, frame)) for k in range(3)], Budget(steps=20))
    held, truth = scaled(HELD), taken(HELD, (FRAMES - 1) * FRAME_S)
    color = field.snapshot().render(held.camera_to_world, held.intrinsics).color
    assert psnr(color, truth.image / 255.0) > _usual() - 0.5


@pytest.mark.stability
@pytest.mark.parametrize("level", [0, 128])
def test_where_stereo_finds_nothing_the_plates_are_learned_alone(level: int) -> None:
    """Darkness, and a wall of one color before all cameras."""
    field = LayeredField(SMALL)
    for frame in range(20):
        views = [_frame(k, frame) for k in range(3)]
        field.fit([replace(v, image=np.full_like(v.image, level)) for v in views], Budget(steps=5))
    color = field.snapshot().render(HELD.camera_to_world, HELD.intrinsics).color
    assert len(field.still.views) == 3 and np.isfinite(color).all()


@pytest.mark.stability
def test_the_image_recovers_when_light_was_off() -> None:
    field = LayeredField(SMALL)
    for frame in range(FRAMES):
        views = [_frame(k, frame) for k in range(3)]
        dark = 18 <= frame < 22
        field.fit([replace(v, image=v.image // 40 if dark else v.image) for v in views], Budget(steps=20))
    assert field.tracker is not None and _score(field) > _usual() - 1.0
