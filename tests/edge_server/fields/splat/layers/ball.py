"""A ball that moves before fixed cameras, and fields in layers that are shown it."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import Budget, View
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import picture, psnr, ring, seen

SMALL = SplatSettings(gaussians=1200, start=700, seed_cells=32, densify_every=20, threads=2)
CAMERAS, HELD = ring(12)[:11], ring(12)[11]
FRAME_S = 1.0 / 15.0


def place_m(instant_s: float, height_m: float = 0.5) -> NDArray[np.float64]:
    """The ball goes around on a plate."""
    return np.array([0.25 * np.cos(3 * instant_s), 0.25 * np.sin(3 * instant_s), height_m])


def ball_m(instant_s: float, moves: bool) -> NDArray[np.float64]:
    """It comes from aside after a second and a half and goes around."""
    return np.array([5.0, 0.0, 0.5]) if not moves or instant_s < 1.5 else place_m(instant_s)


@cache
def seen_by(camera: int, frame: int, moves: bool) -> View:
    """Each camera at a phase of its own."""
    view, instant_s = CAMERAS[camera], (frame + camera / len(CAMERAS)) * FRAME_S
    image = picture(view.intrinsics, view.camera_to_world, ball_m(instant_s, moves))
    return replace(view, image=image, generated_ns=round(instant_s * 1e9))


def frame_of(number: int, moves: bool = True, cameras: int = len(CAMERAS)) -> list[View]:
    """What the first so many cameras see."""
    return [seen_by(k, number, moves) for k in range(cameras)]


def played(field: Any, frames: range, moves: bool = True, steps: int = 30) -> None:
    for number in frames:
        field.fit(frame_of(number, moves), Budget(steps=steps))


@cache
def moving_field() -> LayeredField:
    field = LayeredField(SMALL)
    played(field, range(42))
    return field


@cache
def known_plates(steps: int) -> dict[str, np.ndarray]:
    """The state of a field that has just begun its layers."""
    field = LayeredField(SMALL)
    played(field, range(17), steps=steps)
    return field.state()


def resumed_field(state: dict[str, np.ndarray] | None = None) -> LayeredField:
    field = LayeredField(SMALL)
    field.load_state(moving_field().state() if state is None else state)
    return field


def score_of(shown: Any, instant_s: float, moves: bool = True) -> float:
    truth = picture(HELD.intrinsics, HELD.camera_to_world, ball_m(instant_s, moves))
    return psnr(shown.render(HELD.camera_to_world, HELD.intrinsics).color, truth / 255.0)


def measured(view: View, image: NDArray, distance_m: NDArray[np.float64]) -> View:
    """The view with this image and depth along the optical axis, 0 for the sky."""
    z = np.where(np.isfinite(distance_m), distance_m * view.intrinsics.rays()[..., 2], 0.0)
    return replace(view, image=image.astype(np.uint8), depth=z.astype(np.float32))


def ball_alone(view: View, ball: NDArray[np.float64]) -> View:
    """What a camera sees and measures."""
    return measured(view, *seen(view.intrinsics, view.camera_to_world, ball))


Change = Callable[[int, int, View], View]
"""Of a camera's number, a frame's, and its view."""


class Rig:
    """Some cameras of a ring of nine, with depth or without, and one that is held out.

    world: what a camera sees, with depth, where the ball is at a place.
    """

    def __init__(
        self,
        cameras: tuple[int, ...],
        held: int,
        size: int = 48,
        depth: bool = True,
        world: Callable[[View, NDArray[np.float64]], View] = ball_alone,
    ) -> None:
        views = ring(9, size)
        self.cameras, self.held, self.depth = [views[k] for k in cameras], views[held], depth
        self.world, self.frame = world, cache(self._frame)

    def _frame(self, camera: int, frame: int) -> View:
        """What a camera sees and measures then, each at a phase of its own."""
        instant_s = (frame + camera / len(self.cameras)) * FRAME_S
        return replace(self.world(self.cameras[camera], place_m(instant_s)), generated_ns=round(instant_s * 1e9))

    def run(
        self,
        field: LayeredField,
        frames: range,
        changed: Change | None = None,
        cameras: int | None = None,
        steps: int = 20,
        seconds: float | None = None,
    ) -> LayeredField:
        """The field after these frames, each as ``changed``, with a budget in seconds if one is given."""
        budget = Budget(steps=steps) if seconds is None else Budget(seconds=seconds)
        for number in frames:
            views = [self.frame(k, number) for k in range(cameras or len(self.cameras))]
            if changed is not None:
                views = [changed(k, number, view) for k, view in enumerate(views)]
            field.fit(views if self.depth else [replace(view, depth=None) for view in views], budget)
        return field

    def score(self, field: LayeredField, frame: int, told: Callable[[View], View] = lambda view: view) -> float:
        """PSNR of what is shown to the held-out camera, dB; fails where it is not finite. told: how the field is told
        of that camera."""
        truth = self.world(self.held, place_m(frame * FRAME_S))
        asked = told(truth)
        color = field.snapshot().render(asked.camera_to_world, asked.intrinsics).color
        assert np.isfinite(color).all()
        return psnr(color, truth.image / 255.0)

    def curve(
        self, field: LayeredField, frames: int, changed: Change, told: Callable[[View], View] = lambda view: view
    ) -> list[float]:
        """The score after each frame, from the first one on."""
        shown_db = []
        for frame in range(frames):
            self.run(field, range(frame, frame + 1), changed)
            shown_db.append(self.score(field, frame, told))
        return shown_db
