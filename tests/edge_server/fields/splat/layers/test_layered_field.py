"""The field in layers: a ball that moves before fixed cameras, a scene at rest, and cameras that move. What its
still field learns of plates, when, and from when on it is shown."""

import itertools
import logging
import subprocess
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import Budget, View
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.layers.layered_state import VERSION
from edge_server.fields.splat.layers.plates import Plate
from tests.edge_server.fields.scenes import picture, psnr
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.layers import ball


def _turning() -> list[View]:
    """Frames of the first camera, each from another place."""
    poses = [camera.camera_to_world for camera in (*ball.CAMERAS[1:4], ball.HELD)]
    return [replace(ball.seen_by(0, frame, True), camera_to_world=pose) for frame, pose in enumerate(poses, start=4)]


def test_it_is_the_still_field_at_first_and_where_a_camera_moves() -> None:
    layered, plain = LayeredField(ball.SMALL), StillField(ball.SMALL)
    for field in (layered, plain):
        ball.played(field, range(4))
    same_state(layered.still, plain)
    assert layered.learning == "learning the background: 4 of 8 frames of each camera"
    for field in (layered, plain):
        for frame, turned in enumerate(_turning(), start=4):
            field.fit([turned, ball.seen_by(2, frame, True)], Budget(steps=10))
    assert not layered.layered and not layered.learning
    ball.played(layered, range(20, 40), steps=2)
    ball.played(plain, range(20, 40), steps=2)
    same_state(layered.still, plain)
    shown, expected = (f.render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color for f in (layered, plain))
    np.testing.assert_array_equal(shown, expected)


def test_one_camera_alone_begins_no_layers_and_is_told_so_once(caplog: pytest.LogCaptureFixture) -> None:
    field = LayeredField(ball.SMALL)
    with caplog.at_level(logging.WARNING):
        for frame in range(20):
            field.fit(ball.frame_of(frame, cameras=1), Budget(steps=1))
    assert field.layered and field.tracker is None and not field.learning and caplog.text.count("gives no depth") == 1
    for frame in range(20, 30):
        field.fit(ball.frame_of(frame, cameras=2), Budget(steps=1))
    assert field.moving is not None and field.learning.endswith("of 50 steps")  # little was shown before


def test_nothing_moves_where_nothing_moves() -> None:
    field = LayeredField(ball.SMALL)
    ball.played(field, range(36), moves=False)
    assert field.moving is not None and len(field.moving) == 0
    assert field.static.finished
    assert field.fit([ball.seen_by(0, 40, False)], Budget(steps=30)).steps == 0  # all is learned
    assert ball.score_of(field.snapshot(), 2.0, moves=False) > 22.0


def test_what_moves_is_shown_at_any_instant() -> None:
    field = ball.moving_field()
    assert field.moving is not None and field.moving.alive
    instant_s = 42 * ball.FRAME_S
    now = field.snapshot(round(instant_s * 1e9))
    assert ball.score_of(now, instant_s) > 22.0
    ahead = now.at(round((instant_s + 0.2) * 1e9))
    assert ball.score_of(ahead, instant_s + 0.2) > ball.score_of(now, instant_s + 0.2) + 0.5
    earlier = now.at(round((instant_s - 0.3) * 1e9))
    assert ball.score_of(earlier, instant_s - 0.3) > ball.score_of(now, instant_s - 0.3) + 1.0
    again = earlier.at(round(instant_s * 1e9))
    np.testing.assert_array_equal(again.params, now.params)


def test_a_state_continues_bit_for_bit_whatever_the_order_of_views_and_the_threads() -> None:
    field, other = ball.resumed_field(), LayeredField(structs.replace(ball.SMALL, threads=1))
    same_state(field, ball.moving_field())
    shown = field.snapshot()
    before = shown.render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color
    ball.played(field, range(42, 44))
    other.load_state(field.state())
    views = [*ball.frame_of(44), *ball.frame_of(45)]
    field.fit(views, Budget(steps=5))
    other.fit(views[::-1], Budget(steps=5))
    field.fit(views[:3], Budget(steps=0))  # of what was taken before, nothing is taken again
    other.fit(views, Budget(steps=0))
    for one in (field, other):
        ball.played(one, range(46, 50))
    same_state(field, other)
    for still in (shown, shown.at(None)):  # a snapshot stays as it is
        np.testing.assert_array_equal(still.render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color, before)


def test_a_state_goes_on_with_the_plates_that_were_learned_in_their_order() -> None:
    """Whatever the order of the cameras' first views; also with that of a camera that was knocked since."""
    field, other = ball.resumed_field(ball.known_plates(30)), LayeredField(ball.SMALL)
    plates = [camera.plate_image(fine=False) for camera in field.cameras.values()]
    field.static.begin(plates[::-1])
    field.static.publish()
    field.static.forget_camera(plates[0].view.camera)
    other.load_state(field.state())
    for each in (field, other):
        each.static.train(StepBudget(Budget(steps=10)))
    same_state(field, other)


def test_it_tells_how_much_moves_before_each_camera_in_its_newest_frame() -> None:
    field = ball.resumed_field()
    newest = {o.camera: o.share for o in sorted(field.observations, key=lambda o: o.instant_s)}
    assert max(newest.values()) > 0.02 and len({*newest.values()}) > 3
    assert field.moving_shares == {name: max(share, 0.01) for name, share in newest.items()}
    field.refused = {ball.CAMERAS[0].camera}
    assert field.moving_shares[ball.CAMERAS[0].camera] == 0.01


def test_a_refused_state_changes_nothing_and_reset_forgets() -> None:
    field, state = ball.resumed_field(), ball.moving_field().state()
    old = str(state["meta"]).replace(f'"version": {VERSION}', '"version": 1')
    for wrong in (
        StillField(ball.SMALL).state(),
        {k: v for k, v in state.items() if k != "moving.anchor"},
        {**state, "moving.share": state["moving.share"] * np.nan},
        {**state, "meta": np.array(old)},
    ):
        with pytest.raises(ValueError):
            field.load_state(wrong)
    same_state(field, ball.moving_field())
    field.reset()
    same_state(field, LayeredField(ball.SMALL))


@pytest.mark.slow
def test_warming_up_compiles_every_kernel() -> None:
    """Nothing is left to compile when a body moves: in a process of its own."""
    code = """
import sys
from numba.core.dispatcher import Dispatcher
from tests.edge_server.fields.splat.layers.ball import SMALL, LayeredField, played
MODULES = [module for name, module in sys.modules.items() if name.startswith("edge_server.fields")]
KERNELS = [k for module in MODULES for k in vars(module).values() if isinstance(k, Dispatcher)]
def compiled():
    return {k.py_func.__name__: len(k.signatures) for k in KERNELS}
field = LayeredField(SMALL)
field.warm_up()
before = compiled()
assert sum(before.values()) > 10
played(field, range(60), steps=10)
assert field.moving is not None and field.moving.alive
assert compiled() == before, (before, compiled())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]


def _fitted_in_seconds(field: LayeredField, frame: int, seconds: float = 0.02) -> Any:
    """The report of a fit with all views of a frame."""
    return field.fit(ball.frame_of(frame), Budget(seconds=seconds))


def test_in_seconds_what_moves_is_followed_once_anything_is_shown_of_it() -> None:
    """Until then the still field has the processor."""
    field, moving = ball.resumed_field(ball.known_plates(5)), ball.resumed_field()
    assert field.tracker is not None and not field.supervision.layers_shown
    followed = field.tracker.fits
    for frame in range(17, 1000):
        report = _fitted_in_seconds(field, frame)
        if field.supervision.layers_shown:
            break
        assert field.tracker.fits == followed and not report.short
    assert field.supervision.layers_shown and field.static.ready
    for later in range(frame + 1, frame + 5):
        _fitted_in_seconds(field, later)
    assert field.tracker.fits == followed + 4
    assert _fitted_in_seconds(moving, 42, 1e-4).short
    for _ in range(5):
        moving.tracker._step_time.add(1.0)  # another process had the core
    assert any(_fitted_in_seconds(moving, later, 0.2).steps for later in range(43, 53)), "slow steps are over"
    for each in (field, moving):
        each.static.stop()


@pytest.mark.parametrize(("threads", "seconds"), [(2, 1), (3, 0)])
def test_the_pool_leaves_a_worker_to_a_thread_that_computes_beside_it(monkeypatch, threads, seconds) -> None:
    """And of two always, where budgets are in seconds: a kernel of both would wait for the one that others hold up."""
    field, spared = LayeredField(structs.replace(ball.SMALL, threads=threads)), list[int]()
    monkeypatch.setattr(field.pool, "spare", spared.append)
    for budget in (Budget(steps=1), Budget(seconds=0.02), Budget(steps=1)):
        field.fit(ball.frame_of(0), budget)
    assert spared == [0, seconds, 0]
    ball.played(field, range(1, 17), steps=5)
    for frame in range(17, 400):
        spared.clear()
        _fitted_in_seconds(field, frame)
        if spared == [seconds, 1]:
            break
    else:
        pytest.fail("it never followed beside the training")
    for turned in _turning():
        field.fit([replace(turned, generated_ns=turned.generated_ns + 60_000_000_000)], Budget(seconds=0.02))
    assert not field.layered and spared[-1] == 0


def test_a_camera_that_shows_something_else_is_refused_and_changes_nothing() -> None:
    without, field, rng = ball.resumed_field(), ball.resumed_field(), np.random.default_rng(0)
    for frame in range(42, 46):
        first, *rest = ball.frame_of(frame)
        without.fit(rest, Budget(steps=5))
        noise = rng.integers(0, 255, first.image.shape, np.uint8)
        report = field.fit([replace(first, image=noise), *rest], Budget(steps=5))
        assert report.refused == (first.camera,)
    one, two = without.snapshot(), field.snapshot()
    for a, b in zip((one.static, one.moving.params), (two.static, two.moving.params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)
    resumed = ball.resumed_field(field.state())
    assert resumed.refused == {first.camera}
    assert resumed.fit(ball.frame_of(46), Budget(steps=5)).refused == ()


def test_layers_begin_again_when_the_box_of_the_scene_changes() -> None:
    field = ball.resumed_field()
    store, plates = field.still.view_store, {n: c.plate for n, c in field.cameras.items()}
    store.box = replace(store.box, radius_m=2.0 * store.box.radius_m)  # as a late camera may have it
    ball.played(field, range(42, 43), steps=5)
    assert field.moving is not None and field.moving.box is field.still.view_store.box and field.still.step == 30
    assert {n: c.plate for n, c in field.cameras.items()} == plates
    assert all(camera.row is not None for camera in field.cameras.values())


def test_it_wants_every_frame_and_tells_how_long_one_takes_until_a_camera_moves() -> None:
    field, ticks = LayeredField(ball.SMALL), itertools.count()
    views = [*ball.frame_of(0), *ball.frame_of(1)]
    assert field.frame_s == 0.0 and field.most_pixels == 400_000  # not known yet
    field.now = lambda: float(next(ticks))
    field.fit(views, Budget(seconds=0.05))
    assert field.frame_s == 1.0 / len(views)
    for turned in _turning():
        field.fit([turned], Budget(steps=1))
    assert field.frame_s is None and field.most_pixels is None
    field.reset()
    assert field.frame_s is not None


def test_a_thread_that_trains_ends_with_the_scene_and_tells_why_it_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    field = ball.resumed_field(ball.known_plates(30))
    _fitted_in_seconds(field, 17, 0.01)
    assert field.static.training
    state = field.state()  # a checkpoint ends it first
    assert not field.static.training
    _fitted_in_seconds(field, 18, 0.01)
    assert field.static.training
    field.reset()
    assert not any(t.name == "static-field" for t in threading.enumerate())

    def fail(pace: Any) -> None:
        raise FloatingPointError("of a test")

    field.load_state(state)
    monkeypatch.setattr(field.static, "train", fail)
    with pytest.raises(FloatingPointError, match="of a test") as raised:
        for frame in range(19, 40):
            _fitted_in_seconds(field, frame, 0.01)
            time.sleep(0.01)
    assert "trained beside" in raised.value.__notes__[0]
    assert not field.static.training  # it is told once


def test_one_wrong_pose_is_left_out_and_a_camera_that_shows_new_places_moves() -> None:
    field = LayeredField(ball.SMALL)
    for frame, place in enumerate([0.0, 0.1, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4]):
        pose = ball.CAMERAS[0].camera_to_world.copy()
        pose[0, 3] += place
        first, *rest = ball.frame_of(frame)
        field.fit([replace(first, camera_to_world=pose), *rest], Budget(steps=1))
        if frame < 4:
            assert field.cameras[first.camera].plate.count == frame + 1 - (frame > 0)
            assert field.refused == ({first.camera} if frame == 1 else set())
        assert field.layered == (frame < 6)  # the fourth place from which it showed something


def test_where_all_cameras_are_knocked_layers_begin_again() -> None:
    """Two cameras on one stand: then nothing is observed from a place that is known."""
    field = LayeredField(ball.SMALL)
    for frame in range(60):
        views = [ball.seen_by(k, frame, True) for k in (0, 5)]
        if frame >= 30:
            for k, view in enumerate(views):
                pose = view.camera_to_world.copy()
                pose[:3, 3] += 0.05
                views[k] = replace(view, camera_to_world=pose)
        field.fit(views, Budget(steps=1))
        assert frame != 29 or field.tracker is not None
        assert frame != 31 or field.tracker is None
    assert field.layered and field.tracker is not None and not any(camera.anew for camera in field.cameras.values())


@pytest.mark.parametrize("order", [(4, 5, 6, 2, 3), (5, 3, 6, 2, 7, 4, 8, 1)])
def test_late_frames_from_where_a_camera_stood_before_change_nothing(order: tuple[int, ...]) -> None:
    """They waited, or were overtaken. Of one that is knocked after frame 4."""
    field, camera = LayeredField(ball.SMALL), ball.seen_by(0, 0, True).camera
    there = ball.CAMERAS[0].camera_to_world.copy()
    there[0, 3] += 0.1
    for frame in (0, *order):
        view, *others = ball.frame_of(frame)
        field.fit([replace(view, camera_to_world=there) if frame > 4 else view, *others], Budget(steps=1))
    stands = field.cameras[camera]
    np.testing.assert_array_equal(stands.reported_pose, there)
    assert field.layered and stands.moves == 1 and camera not in field.refused
    assert stands.plate.count == sum(frame > 5 for frame in order)


def test_few_cameras_with_large_pictures_train_fewer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    field, size = LayeredField(ball.SMALL), ball.HELD.image[..., 0].size
    for frame in range(40):
        field.fit(ball.frame_of(frame, cameras=4), Budget(steps=8))
    for frame, (most_pixels, steps) in enumerate([(size, 10), (size - 1, 6)], 40):
        monkeypatch.setattr(tuned, "FEW_STEPS_PIXELS", most_pixels)
        assert field.fit(ball.frame_of(frame, cameras=4), Budget(steps=30)).steps == steps


# --- what the still field learns, and when it is shown --------------------------------------------


@pytest.mark.parametrize(("level", "plate_s"), [(0.7, 1.0), (0.7, 3.2), (1.0, 1.0)])
def test_cameras_of_different_exposures_agree_on_one(monkeypatch, level: float, plate_s: float) -> None:
    """At level 1, three of the cameras see nearly all in white: of them nothing is believed. After 3.2 s, layers begin
    on what was learned before exposures agreed."""
    monkeypatch.setattr(tuned, "PLATE_S", plate_s)
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
    monkeypatch.setattr(tuned, "EXPOSURE_ROUNDS", 0)
    assert score(differing) > score(begun()) + (1.5 if level < plate_s == 1.0 else -0.5)


def test_layers_begin_before_plates_are_certain_and_the_still_field_anew_when_they_are(monkeypatch) -> None:
    """It goes on from the views with the plates known so far; what it shows stays until the one that begins anew is
    better."""
    for name, value in {"EARLY_S": 0.6, "PLATE_S": 2.0, "EARLY_SHOWN_AFTER": 40}.items():
        monkeypatch.setattr(tuned, name, value)
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
    monkeypatch.setattr(tuned, "SHOWN_AT_LATEST", 90)
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
    """Else a slow machine would show for long what is worse, or nothing of what it learns before plates are certain.
    These ask no field till then."""
    times = {"EARLY_S": 0.6, "PLATE_S": 1.2, "PLATES_SURE_S": 2.0}
    steps = dict(zip(("EARLY_SHOWN_AFTER", "EARLY_STEPS"), learned, strict=True))
    for name, value in (times | steps).items():
        monkeypatch.setattr(tuned, name, value)
    field, asked, take = LayeredField(ball.SMALL), list[bool](), Plate.take

    def told(self: Plate, image: Any, may_refuse: bool = False, by_itself: bool = False) -> Any:
        asked.append(by_itself)
        return take(self, image, may_refuse, by_itself)

    monkeypatch.setattr(Plate, "take", told)
    for frame in range(100):
        field.fit(ball.frame_of(frame, moves=False), Budget(seconds=0.02))
        if field.tracker and not field.supervision.early:
            break
    assert field.observations.newest_s == pytest.approx(anew_s, abs=ball.FRAME_S)
    early = round(0.6 / ball.FRAME_S) + 1
    assert asked[:: len(ball.CAMERAS)] == [k >= early for k in range(frame + 1)]
    while field.supervision.anew:  # the thread is at work on what it knows
        frame += 1
        field.fit(ball.frame_of(frame, moves=False), Budget(seconds=0.02))
    assert field.supervision.earlier is not None, "what is shown stays"
    field.static.stop()


def test_plates_do_not_wait_for_a_camera_that_has_gone_silent() -> None:
    field = LayeredField(ball.SMALL)
    for frame in range(20):
        field.fit(ball.frame_of(frame, False, len(ball.CAMERAS) if frame < 3 else 6), Budget(steps=1))
    assert field.moving is not None
    assert list(field.moving_shares.values()) == [tuned.LEAST_SHARE] * 6  # of those that still tell


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
