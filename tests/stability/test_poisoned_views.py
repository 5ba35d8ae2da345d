"""One camera sends what cannot be: 50 updates later the field is as good as one that never saw it.

A striped ball at 64 x 64, a ring of cameras, one of them poisoned for one update or for ten.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from edge_server.fields import Budget, View
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.view_outliers import MOST_REFUSALS
from tests.edge_server.fields.scenes import psnr, ring
from tests.edge_server.fields.small import CLASSES, NAMES, POISONED

STEPS, WARM, AFTER = 4, 40, 50  # of an update; updates before and after the poison
WITHIN_DB = 0.5
REFUSING = [name for name in NAMES if name != "splat"]  # which learns the next picture instead
VIEWS = ring(13, size=64)
HELD, SEEN, BAD = VIEWS[6], VIEWS[:6] + VIEWS[7:], 3
# Splat's score on one view differs by 0.2 dB between seeds, on these by 0.06.
BETWEEN = ring(26, size=64)[1::4]

Poison = Callable[[View, int], View]


def _noise(view: View, update: int) -> View:
    rng = np.random.default_rng(update)
    return replace(view, image=rng.integers(0, 256, view.image.shape, dtype=np.uint8))


def _black(view: View, update: int) -> View:
    return replace(view, image=np.zeros_like(view.image))


def _inverted(view: View, update: int) -> View:
    """Contradicts all others wherever there is something to see."""
    return replace(view, image=255 - view.image)


def _another_scene(view: View, update: int) -> View:
    return replace(view, image=_room())


@cache
def _room() -> NDArray[np.uint8]:
    scene = make_scene("room", {"count": 2, "width": 64, "height": 64})
    return scene.render(next(iter(scene.cameras)), 0.0)


def _a_meter_off(view: View, update: int) -> View:
    pose = view.camera_to_world.copy()
    pose[:3, 3] += pose[:3, 0]
    return replace(view, camera_to_world=pose)


def _turned(view: View, update: int) -> View:
    pose = view.camera_to_world.copy()
    pose[:3, :3] = pose[:3, :3] @ np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    return replace(view, camera_to_world=pose)


def _in_millimeters(view: View, update: int) -> View:
    pose = view.camera_to_world.copy()
    pose[:3, 3] *= 1000.0
    return replace(view, camera_to_world=pose)


PICTURES: list[Poison] = [_noise, _black, _inverted, _another_scene]
POSES: list[Poison] = [_a_meter_off, _turned, _in_millimeters]


def each_with(
    poisons: list[Poison],
    soon: list[Poison],
    in_slow_tests: tuple[Poison, ...] = (_noise, _in_millimeters),
    names: Sequence[str] = NAMES,
) -> pytest.MarkDecorator:
    """Every poison with splat. Networks take ten times as long, and share what refuses views: they meet
    ``in_slow_tests`` there, for one update, and ngp meets ``soon`` besides."""
    cases = []
    for name in names:
        for poison in poisons:
            at_once = name == "splat" or (name == "ngp" and poison in soon)
            if at_once or poison in in_slow_tests:
                marks = [] if at_once else [pytest.mark.slow]
                cases.append(pytest.param(name, poison, id=f"{name}-{poison.__name__}", marks=marks))
    return pytest.mark.parametrize(("name", "poison"), cases)


def field_of(name: str, **changed: Any) -> Any:
    """A field of these tests, with other settings as ``changed`` says."""
    return CLASSES[name](replace(POISONED[name], **changed))


class Deployment:
    """A field and cameras that go on sending: every update has new frames, equal where nothing changed."""

    def __init__(self, field: Any) -> None:
        self.field, self.updates, self.loss = field, 0, 0.0

    def update(self, times: int, poison: Poison | None = None) -> None:
        for _ in range(times):
            self.updates += 1
            now = [replace(v, generated_ns=self.updates * 10**8, image=v.image.copy()) for v in SEEN]
            if poison is not None:
                now[BAD] = poison(now[BAD], self.updates)
            self.loss = self.field.fit(now, Budget(steps=STEPS)).loss

    def score(self) -> float:
        held = BETWEEN if self.field.name == "splat" else [HELD]
        shown = [self.field.render(view.camera_to_world, view.intrinsics).color for view in held]
        return float(np.mean([psnr(color, view.image / 255.0) for color, view in zip(shown, held)]))


@cache
def _warm(name: str) -> dict[str, NDArray[Any]]:
    deployment = Deployment(field_of(name))
    deployment.update(WARM)
    return deployment.field.state()


def _deployment(name: str) -> Deployment:
    field = field_of(name)
    field.load_state(_warm(name))
    deployment = Deployment(field)
    deployment.updates = WARM
    return deployment


@cache
def _unharmed(name: str, updates: int, warm: bool = True) -> float:
    """The score of a field that never saw the poison, after as many updates."""
    deployment = _deployment(name) if warm else Deployment(field_of(name))
    deployment.update(updates)
    return deployment.score()


def _finite(field: Any) -> None:
    assert all(np.isfinite(a).all() for a in field.state().values() if a.dtype.kind == "f")


@each_with(PICTURES + POSES, soon=[_noise, _a_meter_off])
def test_a_poisoned_view_is_survived(name: str, poison: Poison) -> None:
    _survives(name, poison, 1)


@pytest.mark.slow
@pytest.mark.parametrize("poison", PICTURES + POSES)
@pytest.mark.parametrize("name", ["splat"])
def test_a_view_that_stays_poisoned_is_survived(name: str, poison: Poison) -> None:
    _survives(name, poison, 10)


def _survives(name: str, poison: Poison, updates: int) -> None:
    deployment = _deployment(name)
    deployment.update(updates, poison)
    deployment.update(AFTER)
    _finite(deployment.field)
    expected = _unharmed(name, updates + AFTER)
    assert expected > 22.0 and deployment.score() > expected - WITHIN_DB


@each_with(PICTURES + POSES, soon=[_in_millimeters], in_slow_tests=(_in_millimeters,))
def test_poison_in_the_very_first_update_is_survived(name: str, poison: Poison) -> None:
    """Before anything is known, and where the scene's box is found."""
    deployment = Deployment(field_of(name))
    deployment.update(1, poison)
    deployment.update(AFTER)
    assert deployment.score() > _unharmed(name, 1 + AFTER, warm=False) - WITHIN_DB


@each_with([_noise, _black, _inverted], soon=[_inverted], names=REFUSING)
def test_wrong_pictures_are_refused_while_they_last(name: str, poison: Poison) -> None:
    """What is shown meanwhile is not spoilt either; and without refusals it would be."""
    scores = []
    for options in ({}, {"refuse_beyond": 0.0}):
        deployment = Deployment(field_of(name, **options))
        deployment.field.load_state(_warm(name))
        deployment.updates = WARM
        deployment.update(15, poison)
        scores.append(deployment.score())
    expected = _unharmed(name, 15)
    assert scores[0] > expected - WITHIN_DB, "it was learned from"
    assert scores[1] < scores[0] - 0.5 * WITHIN_DB, "it does no harm anyway: nothing was tested"


@pytest.mark.parametrize("name", REFUSING)
def test_a_picture_that_stays_different_is_learnt_in_the_end(name: str) -> None:
    """The camera was right after all, say because somebody hung a cloth before it: patience ends."""
    deployment = _deployment(name)
    deployment.update(MOST_REFUSALS, _black)
    assert deployment.field.view_store.memory[SEEN[BAD].camera].refusals_left == 0
    refused, losses = deployment.loss, []
    for _ in range(-(-len(SEEN) // STEPS)):
        deployment.update(1, _black)
        losses.append(deployment.loss)
    assert max(losses) > 3.0 * refused, "it still is not learned from"


@pytest.mark.parametrize("name", REFUSING)
def test_a_picture_repeated_is_not_a_scene_in_motion(name: str) -> None:
    """One wrong picture makes all of the next one seem to have moved; equal ones after it must end that."""
    deployment = _deployment(name)
    memory = deployment.field.view_store.memory
    deployment.update(1, _noise)
    deployment.update(1)
    moved = memory[SEEN[BAD].camera].moved
    assert moved is not None and moved.mean() > 0.9
    deployment.update(1)
    assert memory[SEEN[BAD].camera].moved is None


@pytest.mark.parametrize("name", REFUSING)
def test_two_poisoned_views_and_refusals_resume_bit_for_bit(name: str) -> None:
    """Refusals depend on what a state keeps."""
    one = _deployment(name)
    one.update(3, _black)
    field = field_of(name)
    field.load_state(one.field.state())
    two = Deployment(field)
    two.updates = one.updates
    for deployment in (one, two):
        deployment.update(3, _noise)
    a, b = one.field.state(), two.field.state()
    assert one.field.view_store.memory[SEEN[BAD].camera].refusals_left == MOST_REFUSALS - 6
    for name in a.keys() - {"meta"}:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.parametrize("poison", POSES)
def test_the_box_is_not_moved_by_one_wrong_pose(poison: Poison) -> None:
    wrong = [poison(v, 0) if k == BAD else v for k, v in enumerate(SEEN)]
    box, expected = scene_box(wrong), scene_box(SEEN)
    assert np.linalg.norm(np.subtract(box.centre_m, expected.centre_m)) < 0.06 * expected.distance_m
    assert box.radius_m == pytest.approx(expected.radius_m, rel=0.1)
    assert box.near_m == pytest.approx(expected.near_m, rel=0.1) and box.contracted == expected.contracted
