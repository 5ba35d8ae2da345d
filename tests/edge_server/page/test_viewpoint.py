"""The starting viewpoint, and the camera of a visitor's window."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.page.viewpoint import DISTANCES, MARGIN, SEEN_SHARE, initial_viewpoint, row_band, visitor_camera
from freshfield.geometry import look_at, matrix_to_quaternion, quaternion_to_matrix
from tests.edge_server.page.preview import BallScene

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


@pytest.mark.parametrize("spread_deg", [90, 160])
def test_the_visitor_stands_as_near_as_lets_them_see_the_share(spread_deg):
    poses = rig(9, spread_deg)
    eyes, view = poses[:, :3, 3], initial_viewpoint(poses)
    away_m = np.linalg.norm(view.position - TARGET)
    step_m = np.diff(DISTANCES)[0] * view.radius_m

    def share_at(distance_m: float) -> float:
        camera = look_at(TARGET + (view.position - TARGET) * distance_m / away_m, TARGET, view.up)
        x, y, z = ((eyes - camera[:3, 3]) @ camera[:3, :3]).T
        limit = MARGIN * np.tan(np.deg2rad(30.0)) * z  # VERTICAL_FOV_RAD, a square window
        return float(np.mean((z > 0) & (np.abs(x) < limit) & (np.abs(y) < limit)))

    assert DISTANCES[0] * view.radius_m + 1e-6 < away_m < DISTANCES[-1] * view.radius_m - 1e-6
    assert share_at(away_m) >= SEEN_SHARE > share_at(away_m - step_m)
    assert np.allclose(view.look_at, TARGET, atol=1e-6) and view.radius_m == pytest.approx(3.0)
    assert np.allclose(view.up, (0, 0, 1), atol=1e-9)
    poses[:, :3, :2] *= -1  # held upside down
    assert np.allclose(initial_viewpoint(poses).up, (0, 0, -1), atol=1e-9)
    rolling = np.stack([np.eye(4)] * 4)  # evenly: no common up, the first one's is taken
    rolling[1:, :2, :2] = [[[0, -1], [1, 0]], [[-1, 0], [0, -1]], [[0, 1], [-1, 0]]]
    assert np.allclose(initial_viewpoint(rolling).up, (0, -1, 0))


def test_a_ring_has_no_behind_so_the_visitor_stands_behind_its_first_camera():
    poses = rig(12, 330)
    out, first = initial_viewpoint(poses).position - TARGET, poses[0, :3, 3] - TARGET
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
    _, tiny = visitor_camera((0, 0, 0), (1, 0, 0, 0), 0.9, 1, 1, 100)
    assert (tiny.width, tiny.height) == (1, 1) and tiny.fx == pytest.approx(tiny.fy)
    # Bands are the image.
    bands = [(20, 0), (rows - 20, 20)]
    parts = [BallScene(0.7).render(pose, row_band(camera, first, count)).color for count, first in bands]
    assert np.allclose(np.concatenate(parts), BallScene(0.7).render(pose, camera).color, atol=1e-6)
