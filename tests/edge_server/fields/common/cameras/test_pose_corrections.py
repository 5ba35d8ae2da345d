"""Corrections of poses from a gradient: they arrive, stay within bounds, and serve views that were never learned."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.fields.common.cameras.pose_corrections import Leap, PoseCorrections, normal_matrix
from freshfield.geometry import Pinhole, look_at, se3, se3_inverse, so3_exp, world_rays

LENS = Pinhole.from_fov(48, 40, 60.0)
WALL_M = 2.0  # ahead of the cameras


def _wall(pose: np.ndarray) -> np.ndarray:
    """What a camera sees of a smooth pattern on the plane z = WALL_M, float (H, W, 3)."""
    origin, rays = world_rays(LENS, pose)
    at = origin + rays * ((WALL_M - origin[2]) / rays[..., 2])[..., None]
    waves = [np.sin(3.0 * at[..., 0] + k) * np.cos(4.0 * at[..., 1] - k) for k in range(3)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def _view(name: str = "a", at_ns: int = 0, x: float = 0.0) -> View:
    pose = look_at((x, 0.1, 0.0), (x + 0.1, 0.0, WALL_M), up=(0.0, -1.0, 0.0))
    return View(name, np.round(255.0 * _wall(pose)).astype(np.uint8), pose, LENS, at_ns)


def _gradient(image: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """Of the summed squared error, by a shift and a rotation in world axes, by central differences."""
    out = np.zeros(6)
    for k in range(6):
        losses = []
        for by in (1e-4, -1e-4):
            moved = pose.copy()
            if k < 3:
                moved[k, 3] += by
            else:
                moved[:3, :3] = so3_exp(by * np.eye(3)[k - 3]) @ pose[:3, :3]
            losses.append(np.square(_wall(moved) - image).sum())
        out[k] = (losses[0] - losses[1]) / 2e-4
    return out


def _depth(view: View) -> np.ndarray:
    _, rays = world_rays(LENS, np.eye(4))
    ahead = np.asarray(view.camera_to_world)[:3, :3] @ (rays / rays[..., 2:])[..., None]
    return ((WALL_M - view.camera_to_world[2, 3]) / ahead[..., 2, 0]).astype(np.float32)


def test_a_wrong_pose_comes_back_to_where_the_image_was_taken() -> None:
    true = _view()
    wrong = true.camera_to_world.copy()
    wrong[:3, :3] = so3_exp([0.01, -0.015, 0.02]) @ wrong[:3, :3]
    wrong[:3, 3] += (0.02, -0.01, 0.015)
    view, poses = replace(true, camera_to_world=wrong), PoseCorrections(0.3, 5.0)
    poses.set_pose(true, wrong)
    np.testing.assert_allclose(poses.pose(true), wrong, atol=1e-12)
    poses = PoseCorrections(0.3, 5.0)
    image, normal = true.image / 255.0, normal_matrix(true, _depth(true))
    errors = []
    for _ in range(60):
        pose = poses.pose(view)
        errors.append(np.square(_wall(pose) - image).mean())
        assert poses.descend(view, _gradient(image, pose), normal, WALL_M / LENS.fx) == ["a"]
    assert errors[-1] < 0.01 * errors[0]


def test_the_normal_matrix_is_that_of_differences() -> None:
    view = _view()
    pose, slopes = view.camera_to_world, []
    for k in range(6):
        moved = [pose.copy(), pose.copy()]
        for one, by in zip(moved, (1e-3, -1e-3)):
            axis = by * pose[:3, k % 3]
            if k < 3:
                one[:3, 3] += axis
            else:
                one[:3, :3] = so3_exp(axis) @ pose[:3, :3]
        slopes.append((_wall(moved[0]) - _wall(moved[1])).ravel() / 2e-3)
    expected = np.stack(slopes) @ np.stack(slopes).T
    found = normal_matrix(view, _depth(view))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.06)  # a sixteenth of the pixels, central slopes


def test_views_in_between_take_their_neighbors_corrections_in_camera_axes() -> None:
    poses = PoseCorrections(1.0, 20.0)
    first, last = _view("first", 0), _view("last", 100)
    turned = last.camera_to_world.copy()
    turned[:3, :3] = so3_exp([0.0, np.pi / 2, 0.0]) @ turned[:3, :3]
    last = replace(last, camera_to_world=turned)
    local = np.array([0.01, 0.02, -0.03])
    for view in (first, last):
        poses.pose(view)
        axes = view.camera_to_world[:3, :3]
        poses.known[view.camera].rotation, poses.known[view.camera].shift_m = axes @ local, axes @ (2.0 * local)
    asked = _view("asked", 25, x=0.3)
    found = poses.neighbors_in_time(asked)
    assert found == {"first": 0.75, "last": 0.25} and "asked" not in poses.known
    pose = poses.pose_between(asked, found)
    axes = asked.camera_to_world[:3, :3]
    np.testing.assert_allclose(pose[:3, :3], axes @ so3_exp(local), atol=1e-9)
    np.testing.assert_allclose(pose[:3, 3], asked.camera_to_world[:3, 3] + axes @ (2.0 * local), atol=1e-12)
    assert poses.neighbors_in_time(replace(asked, generated_ns=500)) == {"last": 1.0}
    np.testing.assert_array_equal(poses.pose_between(asked, {}), asked.camera_to_world)


def test_poses_reported_after_a_leap_are_taken_back_and_earlier_ones_are_not() -> None:
    """A view taken between the keyframes by which the leap was found lies where its neighbors are."""
    poses, true = PoseCorrections(1.0, 20.0), [_view(f"v{k}", 10 * k, x=0.1 * k) for k in range(6)]
    leap = se3(so3_exp([0.1, -0.2, 0.3]), (0.5, 0.0, -0.8))
    poses.leaps["a"] = (Leap(20, 30, se3_inverse(leap), 0.9),)
    for view in true:
        poses.begin(view, "a")
    frozen = poses.copied()
    poses.leaps["a"] = (*poses.leaps["a"], Leap(40, 50, np.eye(4), 0.0))
    for at_ns, leapt in ((5, False), (20, False), (22, False), (28, True), (30, True), (35, True)):
        expected = _view("asked", at_ns, x=0.01 * at_ns)
        reported = leap @ expected.camera_to_world if leapt else expected.camera_to_world
        for known in (poses, frozen):
            found = known.taken_back(replace(expected, camera_to_world=reported), "a")
            np.testing.assert_allclose(found.camera_to_world, expected.camera_to_world, atol=1e-12)
    back = _view("asked", 52, x=0.52)
    np.testing.assert_array_equal(poses.taken_back(back, "a").camera_to_world, back.camera_to_world)
    assert poses.taken_back(back, "b") is back and "asked" not in poses.known


def test_a_step_moves_the_views_taken_around_it_but_not_those_without_times() -> None:
    for apart_ns, moved in ((1, 9), (0, 1)):
        poses = PoseCorrections(0.3, 5.0)
        views = [_view(f"v{k:02d}", k * apart_ns) for k in range(30)]
        for view in views:
            poses.pose(view)
        normal = normal_matrix(views[0], _depth(views[0]))
        changed = poses.descend(views[0], np.full(6, 5.0), normal, WALL_M / LENS.fx)
        sizes = [np.linalg.norm(poses.known[view.camera].shift_m) for view in views]
        assert len(changed) == np.count_nonzero(sizes) == moved and np.argmax(sizes) == 0
        again = PoseCorrections(0.3, 5.0)
        again.load(poses.meta())
        for one in (poses, again):
            one.descend(views[1], np.full(6, -3.0), normal, WALL_M / LENS.fx)
        assert again.meta() == poses.meta()


@pytest.mark.stability
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_no_gradient_moves_a_pose_out_of_bounds(value: float) -> None:
    poses, view = PoseCorrections(0.1, 2.0), _view()
    poses.pose(view)
    for normal in (np.zeros((6, 6)), normal_matrix(view, _depth(view))):
        for sign in (1.0, -1.0, 1.0, 1.0):
            poses.descend(view, np.full(6, sign * value), normal, WALL_M / LENS.fx)
    known = poses.known["a"]
    assert np.linalg.norm(known.shift_m) <= 0.1 + 1e-12 and np.linalg.norm(known.rotation) <= np.deg2rad(2.0) + 1e-12
    poses.take_back(1.0)
    np.testing.assert_allclose(known.shift_m, 0.0, atol=1e-12)


def test_to_ask_for_what_was_learned_changes_nothing() -> None:
    """Snapshots are read by several threads, also with a known name at another pose."""
    poses = PoseCorrections(0.3, 5.0)
    for k in range(3):
        poses.begin(_view(f"a#{k}", k, 0.1 * k), "a")
        shifted = _view(x=0.1 * k).camera_to_world.copy()
        shifted[0, 3] += 0.05
        poses.set_pose(_view(f"a#{k}", k, 0.1 * k), shifted)
    before = poses.meta()
    assert poses.learned_pose(_view("a#1", 1, 0.1))[0, 3] == pytest.approx(0.15)
    assert poses.learned_pose(_view("a#1", 1, 0.9)) is None and poses.learned_pose(_view("b", 1)) is None
    assert poses.meta() == before and poses.tracks() == ["a"]
