"""The field in layers: a ball that moves before fixed cameras, a scene at rest, and cameras that move."""

from __future__ import annotations

import itertools
import subprocess
import sys
import threading
import time
from dataclasses import replace
from functools import cache
from typing import Any

import cv2
import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import Budget, View
from edge_server.fields.common.training_schedule import StepBudget
from edge_server.fields.registry import make_field
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.layers import settings
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.layers.layered_state import VERSION
from edge_server.fields.splat.layers.plates import Plate
from edge_server.fields.splat.layers.static_layer import StaticLayer
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import picture, psnr, ring
from tests.edge_server.fields.small import same_state

SMALL = SplatSettings(gaussians=1200, start=700, seed_cells=32, densify_every=20, threads=2)
CAMERAS, HELD = ring(12)[:11], ring(12)[11]
FRAME_S = 1.0 / 15.0


def _ball_m(instant_s: float, moves: bool) -> np.ndarray:
    """The ball comes from aside after a second and a half and goes around."""
    if not moves or instant_s < 1.5:
        return np.array([5.0, 0.0, 0.5])
    return np.array([0.25 * np.cos(3 * instant_s), 0.25 * np.sin(3 * instant_s), 0.5])


@cache
def _frame(camera: int, frame: int, moves: bool) -> View:
    """Each camera at a phase of its own."""
    view, instant_s = CAMERAS[camera], (frame + camera / len(CAMERAS)) * FRAME_S
    image = picture(view.intrinsics, view.camera_to_world, _ball_m(instant_s, moves))
    return replace(view, image=image, generated_ns=round(instant_s * 1e9))


def _run(field: Any, frames: range, moves: bool = True, steps: int = 30) -> None:
    for frame in frames:
        field.fit([_frame(k, frame, moves) for k in range(len(CAMERAS))], Budget(steps=steps))


@cache
def _moving() -> LayeredField:
    field = LayeredField(SMALL)
    _run(field, range(42))
    return field


@cache
def _plates_known(steps: int) -> dict[str, np.ndarray]:
    """The state of a field that has just begun its layers."""
    field = LayeredField(SMALL)
    _run(field, range(17), steps=steps)
    return field.state()


def _resumed(state: dict[str, np.ndarray] | None = None) -> LayeredField:
    field = LayeredField(SMALL)
    field.load_state(_moving().state() if state is None else state)
    return field


def _score(shown: Any, instant_s: float, moves: bool = True) -> float:
    truth = picture(HELD.intrinsics, HELD.camera_to_world, _ball_m(instant_s, moves))
    return psnr(shown.render(HELD.camera_to_world, HELD.intrinsics).color, truth / 255.0)


@pytest.mark.parametrize("level", [0.7, 1.0])
def test_cameras_of_different_exposures_agree_on_one(monkeypatch: pytest.MonkeyPatch, level: float) -> None:
    """At level 1, three of the cameras see nearly all in white: of them nothing is believed."""
    stops = np.random.default_rng(3).uniform(-0.45, 0.45, len(CAMERAS))
    gains = 2.0 ** (stops - stops.mean())

    def begun(exposures: np.ndarray) -> LayeredField:
        field = LayeredField(SMALL)
        for frame in range(22):
            views = [_frame(k, frame, False) for k in range(len(CAMERAS))]
            images = [np.clip(v.image * g, 0, 255).astype(np.uint8) for v, g in zip(views, exposures)]
            field.fit([replace(v, image=i) for v, i in zip(views, images)], Budget(steps=30))
        return field

    def score(field: LayeredField) -> float:
        truth = level * picture(HELD.intrinsics, HELD.camera_to_world, _ball_m(0.0, False)) / 255.0
        return psnr(field.snapshot().render(HELD.camera_to_world, HELD.intrinsics).color, truth)

    differing = begun(level * gains)
    found = np.array([camera.plate.gain.mean() for camera in differing.cameras.values()])
    white = np.array([(np.asarray(c.view.image).max(axis=2) > 235).mean() > 0.75 for c in differing.cameras.values()])
    assert (found[white] == 1.0).all() and white.any() == (level == 1.0)
    if level < 1.0:
        assert np.log(found / gains).std() < 0.3 * np.log(gains).std()
        alike = begun(np.full(len(CAMERAS), level))
        assert all((camera.plate.gain == 1.0).all() for camera in alike.cameras.values())
        assert score(differing) > score(alike) - 2.0
    monkeypatch.setattr(settings, "EXPOSURE_ROUNDS", 0)
    assert score(differing) > score(begun(level * gains)) + (1.5 if level < 1.0 else -0.5)


def test_the_option_makes_it() -> None:
    assert type(make_field("splat", {"layers": True, "threads": 1})) is LayeredField
    assert type(make_field("splat", {"threads": 1})) is StillField


def _turning() -> list[View]:
    """Frames of the first camera, each from another place."""
    poses = [camera.camera_to_world for camera in (*CAMERAS[1:4], HELD)]
    return [replace(_frame(0, frame, True), camera_to_world=pose) for frame, pose in enumerate(poses, start=4)]


def test_it_is_the_still_field_at_first_and_where_a_camera_moves() -> None:
    layered, plain = LayeredField(SMALL), StillField(SMALL)
    for field in (layered, plain):
        _run(field, range(4))
    same_state(layered.still, plain)
    assert layered.learning == "learning the background: 4 of 8 frames of each camera"
    for field in (layered, plain):
        for frame, turned in enumerate(_turning(), start=4):
            field.fit([turned, _frame(2, frame, True)], Budget(steps=10))
    assert not layered.layered and not layered.learning
    _run(layered, range(20, 40), steps=2)
    _run(plain, range(20, 40), steps=2)
    same_state(layered.still, plain)
    shown, expected = (f.render(HELD.camera_to_world, HELD.intrinsics).color for f in (layered, plain))
    np.testing.assert_array_equal(shown, expected)


def test_what_was_shown_before_the_plates_are_known_is_shown_until_the_still_field_is_better() -> None:
    """It begins anew with the plates, and is shown after ``SHOWN_AFTER`` steps."""
    field = LayeredField(SMALL)
    _run(field, range(15), moves=False, steps=10)
    params = field.still.cloud.params.copy()
    _run(field, range(15, 18), moves=False, steps=10)
    assert field.moving is not None and 25 < field.still.step < 60
    np.testing.assert_array_equal(field.snapshot().gaussians.params, params)
    _run(field, range(18, 21), moves=False, steps=10)
    np.testing.assert_array_equal(field.snapshot().gaussians.params, field.still.cloud.params)


def test_layers_begin_before_plates_are_certain_and_the_still_field_anew_when_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It goes on from the views with the plates known so far, and learns what becomes known of them at once; what it
    shows stays until the one that begins anew is better."""
    monkeypatch.setattr(settings, "EARLY_S", 0.6)
    monkeypatch.setattr(settings, "PLATE_S", 2.0)
    monkeypatch.setattr(settings, "EARLY_SHOWN_AFTER", 40)
    known: list[float] = []
    learn = StaticLayer.learn

    def told(self: StaticLayer, plates: Any) -> None:
        known.append(float(np.mean([plate.known.mean() for plate in plates])))
        learn(self, plates)

    monkeypatch.setattr(StaticLayer, "learn", told)
    field = LayeredField(SMALL)
    _run(field, range(14), steps=10)
    assert field.tracker is not None and field.supervision.early and len(known) <= 6
    assert field.still.step > 140 and field.static.ready  # ten in each fit since the first frame
    assert field.learning == "learning the background: 0.9 of 2 s"
    _run(field, range(14, 30), steps=10)
    assert len(known) > 2 and known[-1] >= known[0] and field.static.ready
    resumed, score = _resumed(field.state()), _score(field.snapshot(), 29 * FRAME_S)
    for each in (field, resumed):
        _run(each, range(30, 34), steps=10)
    same_state(field, resumed)
    assert not field.supervision.early and not field.learning and field.still.step < 60 and not field.static.ready
    assert _score(field.snapshot(), 33 * FRAME_S) > score - 1.0
    _run(field, range(34, 45), steps=30)
    assert field.supervision.earlier is None and _score(field.snapshot(), 44 * FRAME_S) > score - 0.5


def test_rates_fall_once_over_the_first_schedule(monkeypatch: pytest.MonkeyPatch) -> None:
    """The progress of its steps goes from 0 to 1, in equal steps, and growth ends with it."""
    field, asked = LayeredField(SMALL), list[tuple[float, bool]]()
    step = StillField.train_step

    def told(self: StillField, progress: float, grow: bool) -> tuple[float, int, int]:
        asked.append((progress, grow))
        return step(self, progress, grow)

    monkeypatch.setattr(StillField, "train_step", told)
    _run(field, range(24), moves=False, steps=35)
    first = [progress for progress, grow in asked if grow]
    np.testing.assert_allclose(first, np.arange(200) / 200.0, atol=1e-9)
    rounds = [progress for progress, grow in asked if not grow]
    np.testing.assert_allclose(rounds, np.tile(np.arange(10) / 10.0, 5), atol=1e-9)
    assert not any(grow for _, grow in asked[200:])


def test_one_camera_alone_begins_no_layers() -> None:
    field = LayeredField(SMALL)
    for frame in range(20):
        field.fit([_frame(0, frame, True)], Budget(steps=1))
    assert field.layered and field.moving is None and not field.learning and field.part_s["static field"] > 0.0
    for frame in range(20, 30):
        field.fit([_frame(k, frame, True) for k in range(2)], Budget(steps=1))
    assert field.moving is not None and field.learning.endswith("of 50 steps")  # little was shown before


def test_nothing_moves_where_nothing_moves() -> None:
    field = LayeredField(SMALL)
    _run(field, range(36), moves=False)
    assert field.moving is not None and len(field.moving) == 0
    assert field.static.finished
    report = field.fit([_frame(0, 40, False)], Budget(steps=30))
    assert report.steps == 0  # all is learned
    assert _score(field.snapshot(), 2.0, moves=False) > 22.0


def test_what_moves_is_shown_at_any_instant() -> None:
    field = _moving()
    assert field.moving is not None and field.moving.alive
    instant_s = 42 * FRAME_S
    now = field.snapshot(round(instant_s * 1e9))
    assert _score(now, instant_s) > 22.0
    ahead = now.at(round((instant_s + 0.2) * 1e9))
    assert _score(ahead, instant_s + 0.2) > _score(now, instant_s + 0.2) + 0.5
    earlier = now.at(round((instant_s - 0.3) * 1e9))
    assert _score(earlier, instant_s - 0.3) > _score(now, instant_s - 0.3) + 1.0
    again = earlier.at(round(instant_s * 1e9))
    np.testing.assert_array_equal(again.gaussians.params, now.gaussians.params)


def test_a_snapshot_stays_as_it_is() -> None:
    field = _resumed()
    shown = field.snapshot()
    before = shown.render(HELD.camera_to_world, HELD.intrinsics).color
    _run(field, range(42, 45))
    np.testing.assert_array_equal(shown.render(HELD.camera_to_world, HELD.intrinsics).color, before)
    np.testing.assert_array_equal(shown.at(None).render(HELD.camera_to_world, HELD.intrinsics).color, before)


def test_a_state_continues_bit_for_bit() -> None:
    field = _resumed()
    same_state(field, _moving())
    _run(field, range(42, 44))
    other = _resumed(field.state())
    for one in (field, other):
        _run(one, range(44, 50))
    same_state(field, other)
    one, two = (f.render(HELD.camera_to_world, HELD.intrinsics).color for f in (field, other))
    np.testing.assert_array_equal(one, two)


def test_a_state_of_a_field_that_is_not_shown_yet_continues_bit_for_bit() -> None:
    """What it shows meanwhile, too."""
    field = LayeredField(SMALL)
    _run(field, range(17), steps=5)
    assert field.supervision.earlier is not None and not field.supervision.layers_shown
    other = _resumed(_plates_known(5))
    for frame in range(17, 45):
        for one in (field, other):
            _run(one, range(frame, frame + 1), steps=5)
        one, two = (f.render(HELD.camera_to_world, HELD.intrinsics).color for f in (field, other))
        np.testing.assert_array_equal(one, two)
    assert field.supervision.layers_shown
    same_state(field, other)
    with pytest.raises(ValueError, match="what was shown before layers are"):
        field.load_state({**_plates_known(5), "earlier": np.zeros((5, 3), np.float32)})


def test_it_tells_how_much_moves_before_each_camera_in_its_newest_frame() -> None:
    field = _resumed()
    newest = {o.camera: o.share for o in sorted(field.observations, key=lambda o: o.instant_s)}
    assert max(newest.values()) > 0.02 and len({*newest.values()}) > 3
    assert field.moving_shares == {name: max(share, 0.01) for name, share in newest.items()}
    field.refused = {CAMERAS[0].camera}
    assert field.moving_shares[CAMERAS[0].camera] == 0.01


def test_the_order_and_the_threads_change_nothing() -> None:
    one, two = LayeredField(SMALL), LayeredField(structs.replace(SMALL, threads=1))
    for field in (one, two):
        field.load_state(_moving().state())
    views = [_frame(k, frame, True) for frame in (42, 43) for k in range(len(CAMERAS))]
    one.fit(views, Budget(steps=5))
    two.fit(views[::-1], Budget(steps=5))
    two.fit(views, Budget(steps=0))
    one.fit(views[:3], Budget(steps=0))
    same_state(one, two)


def test_a_refused_state_changes_nothing() -> None:
    field = LayeredField(SMALL)
    _run(field, range(2))
    before = field.state()
    for wrong in (
        StillField(SMALL).state(),
        {k: v for k, v in _moving().state().items() if k != "moving.anchor"},
        {k: v * np.nan if k == "moving.share" else v for k, v in _moving().state().items()},
        {
            k: np.array(str(v).replace(f'"version": {VERSION}', '"version": 1')) if k == "meta" else v
            for k, v in _moving().state().items()
        },
    ):
        with pytest.raises(ValueError):
            field.load_state(wrong)
    after = field.state()
    assert all(np.array_equal(after[name], array) for name, array in before.items())


def test_reset_forgets() -> None:
    field = _resumed()
    field.reset()
    same_state(field, LayeredField(SMALL))


def test_warming_up_compiles_every_kernel() -> None:
    """Nothing is left to compile when a body moves: in a process of its own."""
    code = """
from numba.core.dispatcher import Dispatcher
from edge_server.fields.common.kernels import plane_sweep, visual_hull
from edge_server.fields.splat.kernels import bin_tiles, optimizer_step, project, rasterize
from edge_server.fields.splat.layers.kernels import align, plates, solve
from edge_server.fields.splat.layers.layered_field import LayeredField
from tests.edge_server.fields.splat.layers.test_layered_field import SMALL, _run
def compiled():
    found = {}
    still = (bin_tiles, optimizer_step, plane_sweep, project, rasterize)
    for module in (align, plates, solve, visual_hull, *still):
        kernels = {k for k in vars(module).values() if isinstance(k, Dispatcher)}
        found |= {(module.__name__, k.py_func.__name__): len(k.signatures) for k in kernels}
    return found
field = LayeredField(SMALL)
field.warm_up()
before = compiled()
assert sum(before.values()) > 10
_run(field, range(60), steps=10)
assert field.moving is not None and field.moving.alive and field.part_s["solving"] > 0.0
assert compiled() == before, (before, compiled())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr[-2000:]


def test_in_seconds_the_static_field_learns_beside_what_moves() -> None:
    field = _resumed(_plates_known(30))
    assert field.tracker is not None and not field.static.finished
    frame = 17
    while frame < 50 or (frame < 300 and not (field.static.finished and field.moving.steps > 0)):  # a busy machine
        began = time.perf_counter()
        field.fit([_frame(k, frame, True) for k in range(len(CAMERAS))], Budget(seconds=0.05))
        time.sleep(max(0.1 - (time.perf_counter() - began), 0.0))
        frame += 1
    assert field.moving.steps > 0
    assert field.static.finished
    assert _score(field.snapshot(round(frame * FRAME_S * 1e9)), frame * FRAME_S) > 20.0


def test_in_seconds_what_moves_is_followed_once_anything_is_shown_of_it() -> None:
    """Until then the still field has the processor."""
    field = _resumed(_plates_known(5))
    assert field.tracker is not None and not field.supervision.layers_shown
    followed = field.tracker.fits
    for frame in range(17, 300):
        report = field.fit([_frame(k, frame, True) for k in range(len(CAMERAS))], Budget(seconds=0.02))
        if field.supervision.layers_shown:
            break
        assert field.tracker.fits == followed and not report.short
    assert field.static.ready
    for later in range(frame + 1, frame + 5):
        field.fit([_frame(k, later, True) for k in range(len(CAMERAS))], Budget(seconds=0.02))
    assert field.tracker.fits == followed + 4
    while not field.moving.alive and later < 400:
        later += 1
        report = field.fit([_frame(k, later, True) for k in range(len(CAMERAS))], Budget(seconds=0.02))
        assert field.moving.alive or not report.short, "there was nothing to learn"
    assert field.fit([_frame(k, later + 1, True) for k in range(len(CAMERAS))], Budget(seconds=1e-4)).short
    field.static.stop()


@pytest.mark.parametrize(("threads", "seconds", "follows"), [(2, 1, 1), (3, 0, 1)])
def test_the_pool_leaves_a_worker_to_a_thread_that_computes_beside_it(
    monkeypatch: pytest.MonkeyPatch, threads: int, seconds: int, follows: int
) -> None:
    """And of two always, where budgets are in seconds: a kernel of both would wait for the one that others hold up."""
    field, spared = LayeredField(structs.replace(SMALL, threads=threads)), list[int]()
    spare = field.pool.spare
    monkeypatch.setattr(field.pool, "spare", lambda count: (spared.append(count), spare(count)))
    frames = [_frame(k, 0, True) for k in range(len(CAMERAS))]
    for budget in (Budget(steps=1), Budget(seconds=0.02), Budget(steps=1)):
        field.fit(frames, budget)
    assert spared == [0, seconds, 0]
    _run(field, range(1, 17), steps=5)
    for frame in range(17, 400):
        spared.clear()
        field.fit([_frame(k, frame, True) for k in range(len(CAMERAS))], Budget(seconds=0.02))
        if spared == [seconds, follows]:
            break
    else:
        pytest.fail("it never followed beside the training")
    for turned in _turning():
        turned = replace(turned, generated_ns=turned.generated_ns + 60_000_000_000)
        field.fit([turned], Budget(seconds=0.02))
    assert not field.layered and spared[-1] == 0
    field.pool.spare(1)
    field.reset()
    assert spared[-1] == 0


@pytest.mark.parametrize(("shown_after", "anew_s"), [(20, 1.2), (10_000, 2.0)])
def test_in_seconds_the_still_field_begins_anew_after_it_was_shown_or_late(
    monkeypatch: pytest.MonkeyPatch, shown_after: int, anew_s: float
) -> None:
    """Else nobody would ever see what a slow machine learns before plates are certain."""
    for name, value in {"EARLY_S": 0.6, "PLATE_S": 1.2, "PLATES_SURE_S": 2.0, "EARLY_SHOWN_AFTER": shown_after}.items():
        monkeypatch.setattr(settings, name, value)
    field, frame = LayeredField(SMALL), 0
    while not field.tracker or field.supervision.early:
        assert (frame - 1) * FRAME_S < anew_s, "it goes on"
        field.fit([_frame(k, frame, False) for k in range(len(CAMERAS))], Budget(seconds=0.02))
        frame += 1
    assert field.observations.newest_s == pytest.approx(anew_s, abs=FRAME_S)
    while field.supervision.anew:  # the thread is at work on what it knows
        field.fit([_frame(k, frame, False) for k in range(len(CAMERAS))], Budget(seconds=0.02))
        frame += 1
    assert field.supervision.earlier is not None, "what is shown stays"
    field.static.stop()


def test_a_still_field_that_began_anew_is_shown_once_it_fits_as_well_as_what_it_replaces(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    field = LayeredField(SMALL)
    _run(field, range(24), moves=False, steps=35)
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


def test_plates_ask_no_field_before_they_are_certain(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(settings, "EARLY_S", 0.6)
    field, asked = LayeredField(SMALL), dict[int, bool]()
    take = Plate.take

    def told(self: Plate, image: Any, may_refuse: bool = False, by_itself: bool = False) -> Any:
        asked[self.count] = by_itself
        return take(self, image, may_refuse, by_itself)

    monkeypatch.setattr(Plate, "take", told)
    _run(field, range(20), steps=1)
    first, last = round(0.6 / FRAME_S) + 1, round(1.0 / FRAME_S)
    assert [frame for frame, by_itself in asked.items() if by_itself] == list(range(first, last + 1))


def test_a_camera_that_shows_something_else_is_refused_and_changes_nothing() -> None:
    without, field, rng = _resumed(), _resumed(), np.random.default_rng(0)
    for frame in range(42, 46):
        views = [_frame(k, frame, True) for k in range(len(CAMERAS))]
        image = views[0].image
        shown = rng.integers(0, 255, image.shape, np.uint8)
        without.fit(views[1:], Budget(steps=5))
        report = field.fit([replace(views[0], image=shown), *views[1:]], Budget(steps=5))
        assert report.refused == (CAMERAS[0].camera,)
    one, two = without.snapshot(), field.snapshot()
    for a, b in zip((one.static, one.moving.params), (two.static, two.moving.params), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-3)
    resumed = _resumed(field.state())
    assert resumed.refused == {CAMERAS[0].camera}
    views = [_frame(k, 46, True) for k in range(len(CAMERAS))]
    assert resumed.fit(views, Budget(steps=5)).refused == ()


def test_layers_begin_again_when_the_box_of_the_scene_changes() -> None:
    field = _resumed()
    store, plates = field.still.view_store, {n: c.plate for n, c in field.cameras.items()}
    store.box = replace(store.box, radius_m=2.0 * store.box.radius_m)  # as a late camera may have it
    _run(field, range(42, 43), steps=5)
    assert field.moving is not None and field.moving.box is field.still.view_store.box
    assert field.still.step == 30
    assert {n: c.plate for n, c in field.cameras.items()} == plates
    assert all(camera.row is not None for camera in field.cameras.values())


def test_plates_do_not_wait_for_a_camera_that_has_gone_silent() -> None:
    field = LayeredField(SMALL)
    for frame in range(20):
        field.fit([_frame(k, frame, False) for k in range(len(CAMERAS) if frame < 3 else 6)], Budget(steps=1))
    assert field.moving is not None
    assert list(field.moving_shares.values()) == [settings.LEAST_SHARE] * 6  # of those that still tell


def test_few_cameras_with_large_pictures_train_fewer_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    field, size = LayeredField(SMALL), CAMERAS[0].intrinsics.width * CAMERAS[0].intrinsics.height
    for frame in range(40):
        field.fit([_frame(k, frame, True) for k in range(4)], Budget(steps=30))
    for frame, (most_pixels, steps) in enumerate([(size, 10), (size - 1, 6)], 40):
        monkeypatch.setattr(settings, "FEW_STEPS_PIXELS", most_pixels)
        report = field.fit([_frame(k, frame, True) for k in range(4)], Budget(steps=30))
        assert report.steps == steps


def test_it_wants_every_frame_and_tells_how_long_one_takes_until_a_camera_moves() -> None:
    field, ticks = LayeredField(SMALL), itertools.count()
    views = [_frame(k, frame, True) for frame in range(2) for k in range(len(CAMERAS))]
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
    field = _resumed(_plates_known(30))
    field.fit([_frame(k, 17, True) for k in range(len(CAMERAS))], Budget(seconds=0.01))
    assert field.static.training
    state = field.state()  # a checkpoint ends it first
    assert not field.static.training
    field.fit([_frame(k, 18, True) for k in range(len(CAMERAS))], Budget(seconds=0.01))
    assert field.static.training
    field.reset()
    assert not any(t.name == "static-field" for t in threading.enumerate())
    field.load_state(state)

    def fail(pace: Any) -> None:
        raise FloatingPointError("of a test")

    monkeypatch.setattr(field.static, "train", fail)
    with pytest.raises(FloatingPointError, match="of a test"):
        for frame in range(19, 40):
            field.fit([_frame(k, frame, True) for k in range(len(CAMERAS))], Budget(seconds=0.01))
            time.sleep(0.01)
    field.load_state(state)
    monkeypatch.setattr(field.static, "train", fail)
    field.fit([_frame(k, 19, True) for k in range(len(CAMERAS))], Budget(seconds=0.01))
    with pytest.raises(FloatingPointError, match="of a test") as raised:
        field.state()
    assert "trained beside" in raised.value.__notes__[0]
    assert not field.static.training  # it is told once


def test_one_wrong_pose_is_left_out_and_a_camera_that_shows_new_places_moves() -> None:
    field = LayeredField(SMALL)
    for frame in range(8):
        place = [0.0, 0.1, 0.0, 0.0, 0.1, 0.2, 0.3, 0.4][frame]
        pose = CAMERAS[0].camera_to_world.copy()
        pose[0, 3] += place
        views = [_frame(k, frame, True) for k in range(len(CAMERAS))]
        field.fit([replace(views[0], camera_to_world=pose), *views[1:]], Budget(steps=1))
        if frame < 4:
            assert field.cameras[views[0].camera].plate.count == frame + 1 - (frame > 0)
            assert field.refused == ({views[0].camera} if frame == 1 else set())
        assert field.layered == (frame < 6)  # the fourth place from which it showed something


def test_where_all_cameras_are_knocked_layers_begin_again() -> None:
    """Two cameras on one stand: then nothing is observed from a place that is known."""
    field = LayeredField(SMALL)
    for frame in range(60):
        views = [_frame(k, frame, True) for k in (0, 5)]
        if frame >= 30:
            for k, view in enumerate(views):
                pose = view.camera_to_world.copy()
                pose[:3, 3] += 0.05
                views[k] = replace(view, camera_to_world=pose)
        field.fit(views, Budget(steps=1))
        assert frame != 29 or field.tracker is not None
        assert frame != 31 or field.tracker is None
    assert field.layered and field.tracker is not None and not any(camera.anew for camera in field.cameras.values())


def _small(camera: int, frame: int) -> View:
    """A frame at half its size, as the decoder gives it; its whole is there when asked for."""
    whole = _frame(camera, frame, True)
    size = whole.image.shape[1] // 2, whole.image.shape[0] // 2
    image = np.asarray(cv2.resize(whole.image, size, interpolation=cv2.INTER_AREA))
    return replace(whole, image=image, intrinsics=whole.intrinsics.halved(1), whole=lambda: whole)


def test_fine_plates_are_collected_from_the_first_frame_on() -> None:
    """Four whole frames a fit, of the cameras that have the fewest; not only once the plates are known. The still field
    learns them when there are four of each."""
    field, fewest = LayeredField(SMALL), 0
    for frame in range(80):
        field.fit([_small(k, frame) for k in range(len(CAMERAS))], Budget(steps=1))
        if field.supervision.fine:
            break
        counts = [camera.fine_count for camera in field.cameras.values()]
        fewest = min(counts)
        assert max(counts) - fewest <= 1 and (sum(counts) == 4 * (frame + 1) or field.supervision.exposure_rounds > 0)
    assert field.supervision.fine and fewest >= 4


def test_fine_plates_are_collected_in_each_fit_until_they_are_known_and_then_less_often() -> None:
    field, taken = LayeredField(SMALL), []
    for frame in range(60):
        for cameras in (range(6), range(6, len(CAMERAS))):  # 33 ms apart
            field.fit([_small(k, frame) for k in cameras], Budget(steps=1))
            taken.append((field.supervision.fine, sum(camera.fine_count for camera in field.cameras.values())))
    known = next(k for k, (fine, _) in enumerate(taken) if fine)
    before, after = np.diff([count for _, count in taken[:known]]), np.diff([count for _, count in taken[known:]])
    assert (before == 4).mean() > 0.9 and after.sum() == (len(after) + 1) // 2
