"""The field in layers: a ball that moves before fixed cameras, a scene at rest, and cameras that move."""

from __future__ import annotations

import itertools
import logging
import subprocess
import sys
import threading
import time
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import Budget, View
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.layers import settings
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.layers.layered_state import VERSION
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
    assert field.layered and field.tracker is None and not field.learning and caplog.text.count("tells no depth") == 1
    for frame in range(20, 30):
        field.fit(ball.frame_of(frame, cameras=2), Budget(steps=1))
    assert field.moving is not None and field.learning.endswith("of 50 steps")  # little was shown before


def test_nothing_moves_where_nothing_moves() -> None:
    field = LayeredField(ball.SMALL)
    ball.played(field, range(36), moves=False)
    assert field.moving is not None and len(field.moving) == 0
    assert field.static.finished
    report = field.fit([ball.seen_by(0, 40, False)], Budget(steps=30))
    assert report.steps == 0  # all is learned
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
    np.testing.assert_array_equal(again.gaussians.params, now.gaussians.params)


def test_a_state_continues_bit_for_bit_and_a_snapshot_stays_as_it_is() -> None:
    field = ball.resumed_field()
    same_state(field, ball.moving_field())
    shown = field.snapshot()
    before = shown.render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color
    ball.played(field, range(42, 44))
    other = ball.resumed_field(field.state())
    for one in (field, other):
        ball.played(one, range(44, 50))
    same_state(field, other)
    one, two = (f.render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color for f in (field, other))
    np.testing.assert_array_equal(one, two)
    for still in (shown, shown.at(None)):
        np.testing.assert_array_equal(still.render(ball.HELD.camera_to_world, ball.HELD.intrinsics).color, before)


def test_it_tells_how_much_moves_before_each_camera_in_its_newest_frame() -> None:
    field = ball.resumed_field()
    newest = {o.camera: o.share for o in sorted(field.observations, key=lambda o: o.instant_s)}
    assert max(newest.values()) > 0.02 and len({*newest.values()}) > 3
    assert field.moving_shares == {name: max(share, 0.01) for name, share in newest.items()}
    field.refused = {ball.CAMERAS[0].camera}
    assert field.moving_shares[ball.CAMERAS[0].camera] == 0.01


def test_the_order_and_the_threads_change_nothing() -> None:
    one, two = ball.resumed_field(), LayeredField(structs.replace(ball.SMALL, threads=1))
    two.load_state(ball.moving_field().state())
    views = [ball.seen_by(k, frame, True) for frame in (42, 43) for k in range(len(ball.CAMERAS))]
    one.fit(views, Budget(steps=5))
    two.fit(views[::-1], Budget(steps=5))
    two.fit(views, Budget(steps=0))
    one.fit(views[:3], Budget(steps=0))
    same_state(one, two)


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
from numba.core.dispatcher import Dispatcher
from edge_server.fields.common.kernels import plane_sweep, visual_hull
from edge_server.fields.splat.kernels import bin_tiles, optimizer_step, project, rasterize
from edge_server.fields.splat.layers.kernels import align, plates, solve
from tests.edge_server.fields.splat.layers.ball import SMALL, LayeredField, played
MODULES = align, plates, solve, visual_hull, bin_tiles, optimizer_step, plane_sweep, project, rasterize
KERNELS = [k for module in MODULES for k in vars(module).values() if isinstance(k, Dispatcher)]
def compiled():
    return {k.py_func.__name__: len(k.signatures) for k in KERNELS}
field = LayeredField(SMALL)
field.warm_up()
before = compiled()
assert sum(before.values()) > 10
played(field, range(60), steps=10)
assert field.moving is not None and field.moving.alive and field.part_s["solving"] > 0.0
assert compiled() == before, (before, compiled())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]


def _fitted_in_seconds(field: LayeredField, frame: int, seconds: float = 0.02) -> Any:
    """The report of a fit with all views of a frame."""
    return field.fit(ball.frame_of(frame), Budget(seconds=seconds))


def test_in_seconds_what_moves_is_followed_once_anything_is_shown_of_it() -> None:
    """Until then the still field has the processor."""
    field = ball.resumed_field(ball.known_plates(5))
    assert field.tracker is not None and not field.supervision.layers_shown
    followed = field.tracker.fits
    for frame in range(17, 1000):
        report = _fitted_in_seconds(field, frame)
        if field.supervision.layers_shown:
            break
        assert field.tracker.fits == followed and not report.short
    else:
        pytest.fail("nothing was shown of what moves")
    assert field.static.ready
    for _ in range(4):
        frame += 1
        _fitted_in_seconds(field, frame)
    assert field.tracker.fits == followed + 4
    while not field.moving.alive and frame < 400:
        frame += 1
        report = _fitted_in_seconds(field, frame)
        assert field.moving.alive or not report.short, "there was nothing to learn"
    assert _fitted_in_seconds(field, frame + 1, 1e-4).short
    field.static.stop()


def test_slow_steps_that_are_over_do_not_end_the_learning_of_what_moves() -> None:
    field = ball.resumed_field()
    tracker, parameters = field.tracker, field.still.adam_parameters(0.3)
    assert tracker is not None and field.moving is not None and field.moving.alive
    for _ in range(5):
        tracker._step_time.add(1.0)  # another process had the core
    made = [tracker.follow(StepBudget(Budget(seconds=0.02), lambda: 0.0), parameters)[0] for _ in range(6)]
    assert made[0] == 0 and made[-1] > 0


@pytest.mark.parametrize(("threads", "seconds", "follows"), [(2, 1, 1), (3, 0, 1)])
def test_the_pool_leaves_a_worker_to_a_thread_that_computes_beside_it(monkeypatch, threads, seconds, follows) -> None:
    """And of two always, where budgets are in seconds: a kernel of both would wait for the one that others hold up."""
    field, spared = LayeredField(structs.replace(ball.SMALL, threads=threads)), list[int]()
    spare = field.pool.spare
    monkeypatch.setattr(field.pool, "spare", lambda count: (spared.append(count), spare(count)))
    frames = [ball.seen_by(k, 0, True) for k in range(len(ball.CAMERAS))]
    for budget in (Budget(steps=1), Budget(seconds=0.02), Budget(steps=1)):
        field.fit(frames, budget)
    assert spared == [0, seconds, 0]
    ball.played(field, range(1, 17), steps=5)
    for frame in range(17, 400):
        spared.clear()
        _fitted_in_seconds(field, frame)
        if spared == [seconds, follows]:
            break
    else:
        pytest.fail("it never followed beside the training")
    for turned in _turning():
        field.fit([replace(turned, generated_ns=turned.generated_ns + 60_000_000_000)], Budget(seconds=0.02))
    assert not field.layered and spared[-1] == 0
    field.pool.spare(1)
    field.reset()
    assert spared[-1] == 0


def test_a_camera_that_shows_something_else_is_refused_and_changes_nothing() -> None:
    without, field, rng = ball.resumed_field(), ball.resumed_field(), np.random.default_rng(0)
    for frame in range(42, 46):
        first, *rest = (ball.seen_by(k, frame, True) for k in range(len(ball.CAMERAS)))
        without.fit(rest, Budget(steps=5))
        noise = rng.integers(0, 255, first.image.shape, np.uint8)
        report = field.fit([replace(first, image=noise), *rest], Budget(steps=5))
        assert report.refused == (first.camera,)
    one, two = without.snapshot(), field.snapshot()
    for a, b in zip((one.static, one.moving.params), (two.static, two.moving.params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)
    resumed = ball.resumed_field(field.state())
    assert resumed.refused == {first.camera}
    assert resumed.fit([ball.seen_by(k, 46, True) for k in range(len(ball.CAMERAS))], Budget(steps=5)).refused == ()


def test_layers_begin_again_when_the_box_of_the_scene_changes() -> None:
    field = ball.resumed_field()
    store, plates = field.still.view_store, {n: c.plate for n, c in field.cameras.items()}
    store.box = replace(store.box, radius_m=2.0 * store.box.radius_m)  # as a late camera may have it
    ball.played(field, range(42, 43), steps=5)
    assert field.moving is not None and field.moving.box is field.still.view_store.box
    assert field.still.step == 30
    assert {n: c.plate for n, c in field.cameras.items()} == plates
    assert all(camera.row is not None for camera in field.cameras.values())


def test_few_cameras_with_large_pictures_train_fewer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    field, size = LayeredField(ball.SMALL), ball.CAMERAS[0].intrinsics.width * ball.CAMERAS[0].intrinsics.height
    for frame in range(40):
        field.fit([ball.seen_by(k, frame, True) for k in range(4)], Budget(steps=30))
    for frame, (most_pixels, steps) in enumerate([(size, 10), (size - 1, 6)], 40):
        monkeypatch.setattr(settings, "FEW_STEPS_PIXELS", most_pixels)
        report = field.fit([ball.seen_by(k, frame, True) for k in range(4)], Budget(steps=30))
        assert report.steps == steps


def test_it_wants_every_frame_and_tells_how_long_one_takes_until_a_camera_moves() -> None:
    field, ticks = LayeredField(ball.SMALL), itertools.count()
    views = [ball.seen_by(k, frame, True) for frame in range(2) for k in range(len(ball.CAMERAS))]
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
    for frame in range(8):
        place = [0.0, 0.1, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4][frame]
        pose = ball.CAMERAS[0].camera_to_world.copy()
        pose[0, 3] += place
        views = [ball.seen_by(k, frame, True) for k in range(len(ball.CAMERAS))]
        field.fit([replace(views[0], camera_to_world=pose), *views[1:]], Budget(steps=1))
        if frame < 4:
            assert field.cameras[views[0].camera].plate.count == frame + 1 - (frame > 0)
            assert field.refused == ({views[0].camera} if frame == 1 else set())
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


def test_late_frames_from_where_a_camera_stood_before_do_not_move_it_back() -> None:
    field, camera = LayeredField(ball.SMALL), ball.seen_by(0, 0, True).camera
    there = ball.CAMERAS[0].camera_to_world.copy()
    there[0, 3] += 0.1
    for frame in (0, 1, 2, 5, 6, 3, 4):  # knocked after frame 4
        view = ball.seen_by(0, frame, True)
        view = replace(view, camera_to_world=there) if frame > 4 else view
        field.fit([view, *(ball.seen_by(k, frame, True) for k in range(1, len(ball.CAMERAS)))], Budget(steps=1))
    np.testing.assert_array_equal(field.cameras[camera].reported_pose, there)
    assert camera not in field.refused
