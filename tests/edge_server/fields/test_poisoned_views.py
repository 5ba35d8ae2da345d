"""One camera sends what cannot be: 30 updates later the field is as good as one that never saw it.

A striped ball at 64 x 64, a ring of cameras, one of them poisoned for one update or for ten.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from edge_server.fields import Budget, View
from edge_server.fields.common.scene_box import scene_box
from tests.edge_server.fields.scenes import psnr, ring
from tests.edge_server.fields.small import every_field, small

STEPS, WARM, AFTER = 4, 40, 30  # of an update; updates before and after the poison
WITHIN_DB = 0.5
VIEWS = ring(13, size=64)
HELD, SEEN, BAD = VIEWS[6], VIEWS[:6] + VIEWS[7:], 3
# Splat's score on one view differs by 0.2 dB between seeds, on these by 0.06.
BETWEEN = ring(26, size=64)[1::4]

pytestmark = pytest.mark.stability

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
    deployment = Deployment(small(name))
    deployment.update(WARM)
    return deployment.field.state()


def _deployment(name: str) -> Deployment:
    field = small(name)
    field.load_state(_warm(name))
    deployment = Deployment(field)
    deployment.updates = WARM
    return deployment


@cache
def _unharmed(name: str, updates: int, warm: bool = True) -> float:
    """The score of a field that never saw the poison, after as many updates."""
    deployment = _deployment(name) if warm else Deployment(small(name))
    deployment.update(updates)
    return deployment.score()


# Also in the very first update: before anything is known, and where the scene's box is found. Networks take ten times
# as long as splat, and share what survives: ngp alone meets one of each kind.
CASES: list[Any] = [("splat", poison, warm) for poison in PICTURES + POSES for warm in (True, False)]
CASES += [pytest.param("ngp", *case, marks=pytest.mark.slow) for case in ((_noise, True), (_in_millimeters, False))]


@pytest.mark.parametrize(("name", "poison", "warm"), CASES)
def test_a_poisoned_view_is_survived(name: str, poison: Poison, warm: bool) -> None:
    deployment = _deployment(name) if warm else Deployment(small(name))
    deployment.update(1, poison)
    deployment.update(AFTER)
    assert all(np.isfinite(a).all() for a in deployment.field.state().values() if a.dtype.kind == "f")
    assert deployment.score() > _unharmed(name, 1 + AFTER, warm) - WITHIN_DB


@every_field
def test_a_picture_repeated_is_not_a_scene_in_motion(name: str) -> None:
    """One wrong picture makes all of the next one seem to have moved; equal ones after it must end that."""
    deployment = Deployment(small(name))
    memory = deployment.field.view_store.memory
    deployment.update(1)
    deployment.update(1, _noise)
    deployment.update(1)
    moved = memory[SEEN[BAD].camera].moved
    assert moved is not None and moved.mean() > 0.9
    deployment.update(1)
    assert memory[SEEN[BAD].camera].moved is None


@pytest.mark.parametrize("poison", POSES)
def test_the_box_is_not_moved_by_one_wrong_pose(poison: Poison) -> None:
    wrong = [poison(v, 0) if k == BAD else v for k, v in enumerate(SEEN)]
    box, expected = scene_box(wrong), scene_box(SEEN)
    assert np.linalg.norm(np.subtract(box.center_m, expected.center_m)) < 0.06 * expected.distance_m
    assert box.radius_m == pytest.approx(expected.radius_m, rel=0.1)
    assert box.near_m == pytest.approx(expected.near_m, rel=0.1) and box.contracted == expected.contracted
