"""What a visitor may look at and from where, and the colors of ages."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.fields import Rendering
from edge_server.live.state import CameraView, Comparison
from edge_server.page import colors, display_modes
from edge_server.page.colors import FRESH, MIDDLE, STALE, UNKNOWN, age_color, age_colors
from edge_server.page.page_constants import FRESH_MS, STALE_MS
from edge_server.page.viewpoint import initial_viewpoint, row_band, visitor_camera
from freshfield.geometry import Pinhole, Pose, look_at, matrix_to_quaternion, quaternion_to_matrix
from tests.edge_server.frames import frame
from tests.edge_server.page.preview import BallScene

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
    image = display_modes.depth_view(rendering)
    assert image.dtype == np.float32 and np.isfinite(image).all()
    assert image[20, 5, 0] > 2 * image[20, 5, 2] and image[20, 60, 2] > image[20, 60, 0]
    assert (image[4] == display_modes.BACKDROP).all() and (image[8, 0] == display_modes.BACKDROP).all()
    assert (display_modes.depth_view(replace(rendering, opacity=0 * rendering.opacity)) == display_modes.BACKDROP).all()


def test_each_place_has_the_age_of_the_newest_frame_that_looks_at_it():
    def camera(name: str, pan_m: float, age_ms: float, held_out: bool = False) -> CameraView:
        pose = Pose.from_matrix(look_at((pan_m, -4.0, 0.5), (pan_m, 0.0, 0.5)))
        return CameraView(name, held_out, replace(frame(camera=name), pose=pose, intrinsics=LENS), age_ms, 1, 0)

    cameras = [camera("old", 0.0, 5000.0), camera("new", 2.3, 20.0), camera("truth", 0.0, 1.0, held_out=True)]
    rendering = flat()
    rendering.depth[:8], rendering.opacity[:8] = 0.01, 0.0  # empty
    image = display_modes.age_view(rendering, FRONT, LENS, [*cameras, CameraView("never", False, None, None, 0, 0)])
    light = display_modes.AGE_VIEW_LIGHT + (1 - display_modes.AGE_VIEW_LIGHT) * 0.5
    assert image[24, 4] / light * 255 == pytest.approx(STALE, abs=2)
    assert image[24, 60] / light * 255 == pytest.approx(FRESH, abs=2)
    assert image[2, 30] / light * 255 == pytest.approx(UNKNOWN, abs=2)
    assert display_modes.age_view(flat(), FRONT, LENS, [])[24, 30] / light * 255 == pytest.approx(UNKNOWN, abs=2)


@pytest.mark.parametrize(("size", "beside"), [((640, 200), True), ((300, 600), False)])
def test_truth_and_rendering_are_as_large_as_they_fit(size, beside):
    truth, rendered = np.full((48, 64, 3), 200, np.uint8), np.full((24, 32, 3), 195, np.uint8)
    comparison = Comparison("cam00", truth, rendered, 3)
    image = display_modes.compared(comparison, *size, error=False)
    assert image.shape == (size[1], size[0], 3)
    shown = (image != display_modes.BACKDROP).all(axis=2)
    assert shown.any(axis=0).sum() > 0.8 * size[0] or shown.any(axis=1).sum() > 0.8 * size[1]
    first = image[:, : size[0] // 2] if beside else image[: size[1] // 2]
    assert np.median(first[(first != display_modes.BACKDROP).all(axis=2)]) == pytest.approx(200 / 255)
    second = image[:, size[0] // 2 :] if beside else image[size[1] // 2 :]
    assert first.max() == second.max() == 1.0, "both are labeled"
    error = display_modes.compared(comparison, *size, error=True)
    assert error[size[1] // 2, size[0] // 2] == pytest.approx(4 * 5 / 255, abs=1e-3)


def test_colors_are_of_256_levels():
    assert all(0 <= part <= 255 for color in vars(colors).values() if isinstance(color, tuple) for part in color)


def test_ends_and_middle_of_the_scale():
    assert age_color(0.0) == age_color(FRESH_MS) == FRESH
    assert age_color(STALE_MS) == age_color(1e9) == STALE
    assert age_color(math.sqrt(FRESH_MS * STALE_MS)) == MIDDLE
    assert age_color(-30.0) == FRESH  # a clock a little ahead
    assert (age_color(None), age_color(float("nan")), age_color(float("inf"))) == (UNKNOWN, STALE, STALE)
    ages = np.array([0.0, 90.0, 400.0, 1e9])
    np.testing.assert_allclose(age_colors(ages), [np.array(age_color(age)) / 255 for age in ages], atol=1e-6)


TARGET = np.array([1.0, -2.0, 0.5])


def rig(count: int, spread_deg: float, elevation_deg: float = 20.0, radius_m: float = 3.0) -> np.ndarray:
    """Cameras on an arc that look at TARGET, world z up."""
    poses = []
    for azimuth in np.deg2rad(np.linspace(-spread_deg / 2, spread_deg / 2, count)):
        e = np.deg2rad(elevation_deg)
        out = np.array([np.cos(azimuth) * np.cos(e), np.sin(azimuth) * np.cos(e), np.sin(e)])
        poses.append(look_at(TARGET + radius_m * out, TARGET))
    return np.stack(poses)


@pytest.mark.parametrize(("cameras_deg", "visitor_deg"), [(20, 30), (35, 45), (0, 18), (60, 55), (-20, 18)])
def test_the_visitor_looks_from_ten_degrees_above_the_cameras_within_bounds(cameras_deg, visitor_deg):
    view = initial_viewpoint(rig(9, 60, cameras_deg))
    out = (view.position - view.look_at) / np.linalg.norm(view.position - view.look_at)
    assert np.rad2deg(np.arcsin(out @ view.up)) == pytest.approx(visitor_deg, abs=0.1)


def test_the_visitor_stands_behind_what_the_cameras_look_at_as_they_hold_up():
    poses = rig(9, 90)
    view = initial_viewpoint(poses)
    assert np.linalg.norm(view.position - TARGET) == pytest.approx(1.9 * 3.0)
    assert np.allclose(view.look_at, TARGET, atol=1e-6) and view.radius_m == pytest.approx(3.0)
    assert np.allclose(view.up, (0, 0, 1), atol=1e-9)
    alone, abreast = rig(1, 0), np.repeat(rig(1, 0), 3, axis=0)
    abreast[:, :3, 3] += abreast[:, :3, 0] * [[-1.5], [0.0], [1.5]]  # looking the same way
    for cameras, ahead_m in ((alone, 1.0), (abreast, 3.0)):
        target = cameras[:, :3, 3].mean(axis=0) + ahead_m * cameras[0, :3, 2]
        assert np.allclose(initial_viewpoint(cameras).look_at, target)
    poses[:, :3, :2] *= -1  # held upside down
    assert np.allclose(initial_viewpoint(poses).up, (0, 0, -1), atol=1e-9)
    ring = rig(12, 330)  # has no behind, so the visitor stands behind its first camera
    out, first = initial_viewpoint(ring).position - TARGET, ring[0, :3, 3] - TARGET
    assert out[:2] @ first[:2] > 0.98 * np.linalg.norm(out[:2]) * np.linalg.norm(first[:2])


@settings(max_examples=50)
@given(
    st.lists(st.tuples(*[st.floats(-1, 1)] * 4, *[st.floats(-1e3, 1e3)] * 3), min_size=1, max_size=8).filter(
        lambda rows: all(np.linalg.norm(r[:4]) > 1e-3 for r in rows)
    )
)
def test_any_poses_give_a_place_from_which_one_can_look(rows):
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    for pose, row in zip(poses, rows):
        pose[:3, :3], pose[:3, 3] = quaternion_to_matrix(row[:4]), row[4:]
    view = initial_viewpoint(poses)
    assert all(np.isfinite(v).all() for v in (view.position, view.look_at, view.up, [view.radius_m]))
    assert np.linalg.norm(view.up) == pytest.approx(1.0)
    gap = view.position - view.look_at
    assert np.linalg.norm(np.cross(gap, view.up)) > 1e-6 * np.linalg.norm(gap)  # never along up


@pytest.mark.parametrize("rows", [60, 151])
def test_a_windows_camera_sees_what_the_window_sees(rows):
    pose = look_at((3, 1, 2), (0, 0, 0))
    wxyz = matrix_to_quaternion(pose[:3, :3])
    found, camera = visitor_camera(pose[:3, 3], wxyz, np.deg2rad(50), 811, 600, rows)
    assert np.allclose(found, pose)
    assert camera.height == rows
    # Corners of the window, whatever the number of rows: half a field of view up, aspect times that aside.
    top = np.tan(np.deg2rad(25))
    corner = camera.project(np.array([top * 811 / 600, top, 1.0]))
    assert np.allclose(corner, (camera.width, camera.height), atol=1e-6)
    _, small = visitor_camera((0, 0, 0), (1, 0, 0, 0), 0.9, 300, 200, 720)
    assert (small.width, small.height) == (300, 200), "never more rows than the window has"
    # Bands are the image.
    bands = [(20, 0), (rows - 20, 20)]
    parts = [BallScene(0.7).render(pose, row_band(camera, first, count)).color for count, first in bands]
    assert np.allclose(np.concatenate(parts), BallScene(0.7).render(pose, camera).color, atol=1e-6)
