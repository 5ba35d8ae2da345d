"""What the still field learns of plates, when, and from when on it is shown."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.layers import settings
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.layers.plates import Plate
from tests.edge_server.fields.scenes import picture, psnr
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.layers import ball


@pytest.mark.parametrize("level", [0.7, 1.0])
def test_cameras_of_different_exposures_agree_on_one(monkeypatch: pytest.MonkeyPatch, level: float) -> None:
    """At level 1, three of the cameras see nearly all in white: of them nothing is believed."""
    stops = np.random.default_rng(3).uniform(-0.45, 0.45, len(ball.CAMERAS))
    gains = 2.0 ** (stops - stops.mean())

    def begun() -> LayeredField:
        field = LayeredField(ball.SMALL)
        for frame in range(22):
            lit = [(v, v.image * level * gain) for v, gain in zip(ball.frame_of(frame, False), gains)]
            field.fit([replace(v, image=np.clip(i, 0, 255).astype(np.uint8)) for v, i in lit], Budget(steps=30))
        return field

    def score(field: LayeredField) -> float:
        truth = level * picture(ball.HELD.intrinsics, ball.HELD.camera_to_world, ball.ball_m(0.0, False)) / 255.0
        return psnr(field.snapshot().render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color, truth)

    differing = begun()
    found = np.array([camera.plate.gain.mean() for camera in differing.cameras.values()])
    white = np.array([(np.asarray(c.view.image).max(axis=2) > 235).mean() > 0.75 for c in differing.cameras.values()])
    assert (found[white] == 1.0).all() and white.any() == (level == 1.0)
    assert level == 1.0 or np.log(found / gains).std() < 0.3 * np.log(gains).std()
    monkeypatch.setattr(settings, "EXPOSURE_ROUNDS", 0)
    assert score(differing) > score(begun()) + (1.5 if level < 1.0 else -0.5)


def test_layers_begin_before_plates_are_certain_and_the_still_field_anew_when_they_are(monkeypatch) -> None:
    """It goes on from the views with the plates known so far; what it shows stays until the one that begins anew is
    better."""
    monkeypatch.setattr(settings, "EARLY_S", 0.6)
    monkeypatch.setattr(settings, "PLATE_S", 2.0)
    monkeypatch.setattr(settings, "EARLY_SHOWN_AFTER", 40)
    field = LayeredField(ball.SMALL)
    ball.played(field, range(14), steps=10)
    assert field.tracker is not None and field.supervision.early
    assert field.still.step > 140 and field.static.ready  # ten in each fit since the first frame
    assert field.learning == "learning the background: 0.9 of 2 s"
    ball.played(field, range(14, 30), steps=10)
    score = ball.score_of(field.snapshot(), 29 * ball.FRAME_S)
    ball.played(field, range(30, 33), steps=10)
    assert field.supervision.earlier is not None
    with pytest.raises(ValueError, match="what was shown before layers are"):
        ball.resumed_field({**field.state(), "earlier": np.zeros((5, 3), np.float32)})
    resumed = ball.resumed_field(field.state())
    for each in (field, resumed):
        ball.played(each, range(33, 35), steps=10)
    same_state(field, resumed)
    assert not field.supervision.early and not field.learning and field.still.step < 60 and not field.static.ready
    assert ball.score_of(field.snapshot(), 34 * ball.FRAME_S) > score - 1.0
    ball.played(field, range(35, 45), steps=30)
    assert field.supervision.earlier is None and ball.score_of(field.snapshot(), 44 * ball.FRAME_S) > score - 0.5


def test_rates_fall_once_over_the_first_schedule(monkeypatch: pytest.MonkeyPatch) -> None:
    """The progress of its steps goes from 0 to 1, in equal steps, and growth ends with it."""
    field, asked = LayeredField(ball.SMALL), list[tuple[float, bool]]()
    step = StillField.train_step

    def told(self: StillField, progress: float, grow: bool) -> tuple[float, int, int]:
        asked.append((progress, grow))
        return step(self, progress, grow)

    monkeypatch.setattr(StillField, "train_step", told)
    ball.played(field, range(24), moves=False, steps=35)
    first = [progress for progress, grow in asked if grow]
    np.testing.assert_allclose(first, np.arange(200) / 200.0, atol=1e-9)
    rounds = [progress for progress, grow in asked if not grow]
    np.testing.assert_allclose(rounds, np.tile(np.arange(10) / 10.0, 5), atol=1e-9)
    assert not any(grow for _, grow in asked[200:])


def test_a_still_field_that_began_anew_is_shown_once_it_fits_as_well_as_what_it_replaces(monkeypatch) -> None:
    field = LayeredField(ball.SMALL)
    ball.played(field, range(24), moves=False, steps=35)
    static, plates = field.static, [camera.plate_image(fine=False) for camera in field.cameras.values()]
    error, step = field.still.error(), field.still.step
    assert 0.0 < error < 0.01 and field.still.step == step
    monkeypatch.setattr(settings, "SHOWN_AT_LATEST", 90)
    ready = {}
    for better_than in (1.0, error, 1e-9):
        static.forget()
        field.still.begin_anew(None)
        static.begin(plates, 20, better_than)
        while not static.ready:
            static.train(StepBudget(Budget(steps=10)))
            static.publish()
        assert static.shown is not None
        ready[better_than] = static.shown.step
    assert ready[1.0] == 20 and ready[error] > 20 and ready[1e-9] == 90
    static._error, static.shown = 1.0, None
    static.publish()
    assert static.ready, "a step that errs takes nothing back"
    static.begin(plates, 20)
    assert not static.ready


@pytest.mark.parametrize(("learned", "anew_s"), [((20, 20), 1.2), ((20, 10_000), 2.0), ((10_000, 20), 2.0)])
def test_in_seconds_the_still_field_begins_anew_once_it_has_learned_and_is_shown_or_late(
    monkeypatch, learned, anew_s
) -> None:
    """Else a slow machine would show for long what is worse, or nothing of what it learns before plates are certain."""
    shown_after, steps = learned
    times = {"EARLY_S": 0.6, "PLATE_S": 1.2, "PLATES_SURE_S": 2.0}
    for name, value in (times | {"EARLY_SHOWN_AFTER": shown_after, "EARLY_STEPS": steps}).items():
        monkeypatch.setattr(settings, name, value)
    field, frame = LayeredField(ball.SMALL), 0
    while not field.tracker or field.supervision.early:
        assert (frame - 1) * ball.FRAME_S < anew_s, "it goes on"
        field.fit([ball.seen_by(k, frame, False) for k in range(len(ball.CAMERAS))], Budget(seconds=0.02))
        frame += 1
    assert field.observations.newest_s == pytest.approx(anew_s, abs=ball.FRAME_S)
    while field.supervision.anew:  # the thread is at work on what it knows
        field.fit([ball.seen_by(k, frame, False) for k in range(len(ball.CAMERAS))], Budget(seconds=0.02))
        frame += 1
    assert field.supervision.earlier is not None, "what is shown stays"
    field.static.stop()


def test_plates_ask_no_field_before_they_are_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(settings, "EARLY_S", 0.6)
    field, asked = LayeredField(ball.SMALL), dict[int, bool]()
    take = Plate.take

    def told(self: Plate, image: Any, may_refuse: bool = False, by_itself: bool = False) -> Any:
        asked[self.count] = by_itself
        return take(self, image, may_refuse, by_itself)

    monkeypatch.setattr(Plate, "take", told)
    ball.played(field, range(20), steps=1)
    first, last = round(0.6 / ball.FRAME_S) + 1, round(1.0 / ball.FRAME_S)
    assert [frame for frame, by_itself in asked.items() if by_itself] == list(range(first, last + 1))


def test_plates_do_not_wait_for_a_camera_that_has_gone_silent() -> None:
    field = LayeredField(ball.SMALL)
    for frame in range(20):
        field.fit(
            [ball.seen_by(k, frame, False) for k in range(len(ball.CAMERAS) if frame < 3 else 6)], Budget(steps=1)
        )
    assert field.moving is not None
    assert list(field.moving_shares.values()) == [settings.LEAST_SHARE] * 6  # of those that still tell


def _small(camera: int, frame: int) -> View:
    """A frame at half its size, as the decoder gives it; its whole is there when asked for."""
    whole = ball.seen_by(camera, frame, True)
    size = whole.image.shape[1] // 2, whole.image.shape[0] // 2
    image = np.asarray(cv2.resize(whole.image, size, interpolation=cv2.INTER_AREA))
    return replace(whole, image=image, intrinsics=whole.intrinsics.halved(1), whole=lambda: whole)


@pytest.mark.slow
def test_fine_plates_are_collected_in_each_fit_until_they_are_known_and_then_less_often() -> None:
    """Four whole frames a fit, of the cameras that have the fewest, until there are four of each."""
    field, taken = LayeredField(ball.SMALL), []
    for frame in range(60):
        for cameras in (range(6), range(6, len(ball.CAMERAS))):  # 33 ms apart
            field.fit([_small(k, frame) for k in cameras], Budget(steps=1))
            counts = [camera.fine_count for camera in field.cameras.values()]
            taken.append((field.supervision.fine, sum(counts), min(counts)))
    known = next(k for k, (fine, *_) in enumerate(taken) if fine)
    gained = np.diff([count for _, count, _ in taken])
    before, after = gained[: known - 1], gained[known:]
    assert (before == 4).mean() > 0.9 and after.sum() == (len(after) + 1) // 2 and taken[known][2] >= 4
