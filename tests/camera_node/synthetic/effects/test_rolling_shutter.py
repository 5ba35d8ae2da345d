"""Each row shows its own instant, and the stamp says which row's it is."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects import load_effects
from camera_node.synthetic.effects.rolling_shutter import RollingShutter
from freshfield.geometry import Pinhole
from tests.camera_node.synthetic.effects.timed_renderer import TimedRenderer

CAMERA = Pinhole.from_fov(4, 11, 60.0)


def make(**parameters: float) -> RollingShutter:
    return RollingShutter(**parameters)  # type: ignore[arg-type]


def clock(t_s: float) -> np.ndarray:
    """Every pixel shows the time: one count a millisecond."""
    return np.full((11, 4, 3), round(1000 * t_s), np.uint8)


@pytest.mark.parametrize(("share", "first_ms"), [(0.0, 100), (0.5, 80), (1.0, 60)])
def test_rows_tell_their_own_time(share, first_ms):
    image = make(readout_ms=40.0, stamped_share=share).expose(TimedRenderer(clock, CAMERA), 0.1)
    assert image[:, 0, 0].tolist() == [first_ms + 4 * row for row in range(11)]
    assert (image == image[:, :1, :1]).all()


@pytest.mark.parametrize("name", ["room", "tower"])
def test_a_row_is_that_of_a_global_shutter_at_the_row_s_instant(name):
    params = {"width": 40, "height": 40, "supersample": 2, "speed_m_per_s": 8.0}
    view = make_scene(name, params).renderer("cam00")
    shutter = make(readout_ms=200.0)
    image = shutter.expose(view, 0.2)
    for row in (0, 13, 20, 26, 39):
        instant = 0.2 + shutter.row_offset_s(row, 40)
        assert instant == pytest.approx(0.2 + (row / 39 - 0.5) * 0.2)
        assert np.array_equal(image[row], view.image(instant)[row])
    assert np.abs(image.astype(int) - view.image(0.2)).max() > 30  # it does matter


def test_several_rows_at_once_are_wrong_by_no_more_than_said():
    fine = make(readout_ms=100.0).expose(TimedRenderer(clock, CAMERA), 0.1).astype(int)
    renderer = TimedRenderer(clock, CAMERA)
    coarse = make(readout_ms=100.0, rows_at_once=4).expose(renderer, 0.1).astype(int)
    assert [rows for _, rows in renderer.asked] == [(0, 4), (4, 8), (8, 11)]
    assert 0 < np.abs(coarse - fine).max() <= 100 * 4 / (2 * 11)


def test_rows_are_the_same_whichever_are_asked_for():
    """Bands of rows are counted from the top of the image, not of what is asked for."""
    shutter = make(readout_ms=100.0, rows_at_once=4)
    whole = shutter.expose(TimedRenderer(clock, CAMERA), 0.1)
    for rows in ((0, 11), (2, 3), (3, 9), (8, 11)):
        assert np.array_equal(shutter.expose(TimedRenderer(clock, CAMERA), 0.1, rows), whole[slice(*rows)])


def test_blurred_rows_are_blurred_around_their_own_instants():
    listed = {
        "motion_blur": {"exposure_ms": 9.0, "samples": 3},
        "rolling_shutter": {"readout_ms": 40.0},
        "vignetting": {"exponent": 0.0},
    }
    made = load_effects(listed, lambda name: np.random.default_rng(0))
    renderer = TimedRenderer(clock, CAMERA)
    assert made.with_exposure(renderer).image(0.1)[:, 0, 0].tolist() == [80 + 4 * row for row in range(11)]
    assert len(renderer.asked) == 33
    first = sorted(t for t, rows in renderer.asked if rows == (0, 1))
    assert first == pytest.approx([0.077, 0.080, 0.083])


@pytest.mark.parametrize("rows", [(0, 1), (7, 19), (31, 32), (0, 32)])
@pytest.mark.parametrize("supersample", [1, 3])
def test_a_renderer_shows_any_of_its_rows(rows, supersample):
    scene = make_scene("room", {"width": 32, "height": 32, "supersample": supersample})
    view = scene.renderer("cam04")
    assert np.array_equal(view.image(1.1, rows), view.image(1.1)[slice(*rows)])
