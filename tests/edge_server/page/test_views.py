"""What a visitor may look at beside the picture, and the colors of ages."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Rendering
from edge_server.live.state import CameraView, Comparison
from edge_server.page import views
from edge_server.page.colors import FRESH, MIDDLE, STALE, UNKNOWN, age_color, age_colors
from edge_server.page.settings import FRESH_MS, STALE_MS
from freshfield.geometry import Pinhole, Pose, look_at
from tests.edge_server.frames import frame

LENS = Pinhole.from_fov(64, 48, 60.0)
FRONT = look_at((0.0, -4.0, 0.5), (0.0, 0.0, 0.5))


def flat(depth_m: float = 4.0) -> Rendering:
    """A gray wall."""
    shape = (LENS.height, LENS.width)
    depth = np.full(shape, depth_m, np.float32)
    return Rendering(np.full((*shape, 3), 0.5, np.float32), depth, np.ones(shape, np.float32))


def test_near_is_red_and_far_is_blue():
    rendering = flat()
    rendering.depth[:, :32] = 2.0
    rendering.depth[:8] = 0.0  # empty
    rendering.depth[8, 0] = np.nan
    image = views.depth_view(rendering)
    assert image.dtype == np.float32 and np.isfinite(image).all()
    assert image[20, 5, 0] > 2 * image[20, 5, 2] and image[20, 60, 2] > image[20, 60, 0]
    assert (image[4] == views.BACKDROP).all() and (image[8, 0] == views.BACKDROP).all()
    assert (views.depth_view(replace(rendering, opacity=0 * rendering.opacity)) == views.BACKDROP).all()


def test_each_place_has_the_age_of_the_newest_frame_that_looks_at_it():
    def camera(name: str, pan_m: float, age_ms: float, held_out: bool = False) -> CameraView:
        pose = Pose.from_matrix(look_at((pan_m, -4.0, 0.5), (pan_m, 0.0, 0.5)))
        return CameraView(name, held_out, replace(frame(camera=name), pose=pose, intrinsics=LENS), age_ms, 1, 0)

    cameras = [camera("old", 0.0, 5000.0), camera("new", 2.3, 20.0), camera("truth", 0.0, 1.0, held_out=True)]
    image = views.age_view(flat(), FRONT, LENS, [*cameras, CameraView("never", False, None, None, 0, 0)])
    light = views.AGE_VIEW_LIGHT + (1 - views.AGE_VIEW_LIGHT) * 0.5
    assert image[24, 4] / light * 255 == pytest.approx(STALE, abs=2)
    assert image[24, 60] / light * 255 == pytest.approx(FRESH, abs=2)
    assert views.age_view(flat(), FRONT, LENS, [])[24, 30] / light * 255 == pytest.approx(UNKNOWN, abs=2)


@pytest.mark.parametrize(("size", "beside"), [((640, 200), True), ((300, 600), False)])
def test_truth_and_rendering_are_as_large_as_they_fit(size, beside):
    truth, rendered = np.full((48, 64, 3), 200, np.uint8), np.full((24, 32, 3), 195, np.uint8)
    comparison = Comparison("cam00", truth, rendered, 3)
    image = views.compared(comparison, *size, error=False)
    assert image.shape == (size[1], size[0], 3)
    shown = (image != views.BACKDROP).all(axis=2)
    assert shown.any(axis=0).sum() > 0.8 * size[0] or shown.any(axis=1).sum() > 0.8 * size[1]
    first = image[:, : size[0] // 2] if beside else image[: size[1] // 2]
    assert np.median(first[(first != views.BACKDROP).all(axis=2)]) == pytest.approx(200 / 255)
    second = image[:, size[0] // 2 :] if beside else image[size[1] // 2 :]
    assert first.max() == second.max() == 1.0, "both are labeled"
    error = views.compared(comparison, *size, error=True)
    assert error[size[1] // 2, size[0] // 2] == pytest.approx(4 * 5 / 255, abs=1e-3)


def test_ends_and_middle_of_the_scale():
    assert age_color(0.0) == age_color(FRESH_MS) == FRESH
    assert age_color(STALE_MS) == age_color(1e9) == STALE
    assert age_color(math.sqrt(FRESH_MS * STALE_MS)) == MIDDLE
    assert age_color(-30.0) == FRESH  # a clock a little ahead
    assert (age_color(None), age_color(float("nan")), age_color(float("inf"))) == (UNKNOWN, STALE, STALE)
    ages = np.array([0.0, 90.0, 400.0, 1e9])
    np.testing.assert_allclose(age_colors(ages), [np.array(age_color(age)) / 255 for age in ages], atol=1e-6)
