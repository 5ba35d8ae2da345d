"""A ball that moves before fixed cameras, and a field in layers that is shown it."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from edge_server.fields import Budget, View
from edge_server.fields.splat.layers.layered_field import LayeredField
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import picture, psnr, ring

SMALL = SplatSettings(gaussians=1200, start=700, seed_cells=32, densify_every=20, threads=2)
CAMERAS, HELD = ring(12)[:11], ring(12)[11]
FRAME_S = 1.0 / 15.0


def ball_m(instant_s: float, moves: bool) -> np.ndarray:
    """The ball comes from aside after a second and a half and goes around."""
    if not moves or instant_s < 1.5:
        return np.array([5.0, 0.0, 0.5])
    return np.array([0.25 * np.cos(3 * instant_s), 0.25 * np.sin(3 * instant_s), 0.5])


@cache
def seen_by(camera: int, frame: int, moves: bool) -> View:
    """Each camera at a phase of its own."""
    view, instant_s = CAMERAS[camera], (frame + camera / len(CAMERAS)) * FRAME_S
    image = picture(view.intrinsics, view.camera_to_world, ball_m(instant_s, moves))
    return replace(view, image=image, generated_ns=round(instant_s * 1e9))


def played(field: Any, frames: range, moves: bool = True, steps: int = 30) -> None:
    for frame in frames:
        field.fit([seen_by(k, frame, moves) for k in range(len(CAMERAS))], Budget(steps=steps))


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
