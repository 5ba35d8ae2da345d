"""Motion blur is the mean over the exposure, centerd on the time stamp."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects.motion_blur import MotionBlur


@dataclass
class Shown:
    """A renderer that shows a function of time."""

    image: Callable[[float], np.ndarray]


def make(exposure_ms: float = 20.0, samples: int = 5) -> MotionBlur:
    return MotionBlur(exposure_ms=exposure_ms, samples=samples)


def ramp(t_s: float) -> np.ndarray:
    """An image that brightens by 100 counts a second, 100 at t = 1."""
    return np.full((2, 2, 3), round(100 * t_s), np.uint8)


def test_the_mean_of_the_exposure_is_at_its_middle():
    asked: list[float] = []

    def render(t_s: float) -> np.ndarray:
        asked.append(t_s)
        return ramp(t_s)

    assert (make(exposure_ms=400.0, samples=8).expose(Shown(render), 1.0) == 100).all()
    assert np.mean(asked) == pytest.approx(1.0)
    assert max(asked) - min(asked) == pytest.approx(0.4 * 7 / 8)
    assert len(asked) == 8


def test_bright_images_do_not_overflow():
    white = np.full((2, 2, 3), 255, np.uint8)
    assert (make(samples=64).expose(Shown(lambda t: white), 0.0) == 255).all()


def test_only_what_moves_is_blurred():
    scene = make_scene("room", {"width": 64, "height": 64, "supersample": 1, "speed_m_per_s": 4.0})
    render = scene.renderer("cam00").image
    sharp, blurred = (render(0.5).astype(int), make(exposure_ms=60.0).expose(scene.renderer("cam00"), 0.5).astype(int))
    changed = np.abs(sharp - blurred).max(axis=-1) > 2
    assert 0.02 < changed.mean() < 0.3
    mean = np.mean([render(0.5 + s) for s in (-0.024, -0.012, 0.0, 0.012, 0.024)], axis=0)
    assert np.abs(blurred - mean).max() <= 0.5
