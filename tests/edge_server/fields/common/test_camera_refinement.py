"""Exposure and pose errors of cameras: learned if enabled, harmless where there are none, else absent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.common.camera_refinement import Exposures, PoseCorrections
from freshfield.geometry import so3_exp
from tests.edge_server.fields.small import SEEN, score, small


def _exposed(views: list[View]) -> tuple[list[View], np.ndarray]:
    """Each camera with its own gain a channel, 1 on average (geometric)."""
    gains = np.exp(np.random.default_rng(3).normal(0.0, 0.3, (len(views), 3)))
    gains /= np.exp(np.log(gains).mean(axis=0))
    images = [np.clip(v.image * g + 0.5, 0, 255).astype(np.uint8) for v, g in zip(views, gains)]
    return [replace(v, image=image) for v, image in zip(views, images)], gains


def _displaced(views: list[View], size_m: float, deg: float) -> list[View]:
    """Each camera off by ``size_m`` and ``deg`` in some direction, not at all on average."""
    rng = np.random.default_rng(5)
    both = rng.normal(size=(2, len(views), 3))
    both -= both.mean(axis=1, keepdims=True)
    both /= np.linalg.norm(both, axis=2, keepdims=True).mean()
    turns, out = both[0] * np.deg2rad(deg), []
    for view, turn, shift in zip(views, turns, both[1] * size_m):
        pose = view.camera_to_world.copy()
        pose[:3, :3] = so3_exp(turn) @ pose[:3, :3]
        pose[:3, 3] += shift
        out.append(replace(view, camera_to_world=pose))
    return out


def _pixels_off(poses: list[np.ndarray]) -> float:
    """By how many pixels points of the scene are seen elsewhere than from SEEN's poses, on average."""
    points = np.random.default_rng(0).normal(size=(50, 3)) * 0.3 + [0.0, 0.0, 0.4]

    def seen(pose: np.ndarray) -> np.ndarray:
        return SEEN[0].intrinsics.project((points - pose[:3, 3]) @ pose[:3, :3])

    pairs = [(seen(pose), seen(view.camera_to_world)) for pose, view in zip(poses, SEEN)]
    return float(np.mean([np.linalg.norm(a - b, axis=1).mean() for a, b in pairs]))


@pytest.mark.parametrize("name", ["ngp", "tensorf"])
def test_gains_are_found_and_the_held_out_view_gains(name: str) -> None:
    views, gains = _exposed(SEEN)
    scores = {}
    for on in (False, True):
        field = small(name, exposure=on, background="#80b2e6", contracted=False)
        field.fit(views, Budget(steps=500))
        scores[on] = score(field)
    assert scores[True] > scores[False] + 1.0
    found = np.array([field._cameras.exposures.known[v.camera][:, 0] for v in views])
    assert np.corrcoef(np.log(found).ravel(), -np.log(gains).ravel())[0, 1] > 0.65


@pytest.mark.slow  # 7 s
def test_poses_are_improved_and_kept_within_their_bounds() -> None:
    views = _displaced(SEEN, 0.02, 1.5)
    scores = {}
    for on in (False, True):
        field = small("ngp", refine_m=0.1 * on, refine_deg=4.0 * on)
        field.fit(views, Budget(steps=600))
        scores[on] = score(field)
    assert scores[True] > scores[False] + 0.5
    assert field._cameras.poses is not None
    before = _pixels_off([v.camera_to_world for v in views])
    after = _pixels_off([field._cameras.poses.pose(v) for v in views])
    assert before > 0.7 and after < 0.75 * before
    tight = small("ngp", refine_m=1e-3, refine_deg=0.1)
    tight.fit(views, Budget(steps=200))
    assert tight._cameras.poses is not None
    for known in tight._cameras.poses.known.values():
        assert np.linalg.norm(known.shift_m) <= 1e-3 + 1e-12
        assert np.linalg.norm(known.rotation) <= np.deg2rad(0.1) + 1e-12


def test_both_repeat_themselves_and_resume_bit_for_bit() -> None:
    refined = {"exposure": True, "refine_m": 0.05, "refine_deg": 2.0}
    views = _exposed(_displaced(SEEN, 0.02, 1.0))[0]
    a, b = small("tensorf", **refined), small("tensorf", threads=1, **refined)
    for field in (a, b):
        field.fit(views, Budget(steps=120))
    c = small("tensorf", **refined)
    c.load_state(a.state())
    for field in (a, b, c):
        field.fit(views, Budget(steps=15))
    one, two, three = a.state(), b.state(), c.state()
    for name in one.keys() - {"meta"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
        np.testing.assert_array_equal(one[name], three[name], err_msg=name)
    assert a._cameras.meta() == b._cameras.meta() == c._cameras.meta()
    assert any(abs(np.array(t)).max() > 0 for _, t, _ in a._cameras.meta()["poses"].values())


def test_nothing_is_allocated_where_nothing_is_asked_for() -> None:
    field = small("ngp")
    field.fit(SEEN, Budget(steps=2))
    assert field._cameras.exposures is None and field._cameras.poses is None
    assert field._batch.exposure.size == 0


def test_what_is_not_finite_or_says_nothing_changes_nothing() -> None:
    exposures = Exposures()
    exposures.rows(["a", "b"])
    exposures.learn(["a", "b"], np.zeros((2, 3, 5)))
    exposures.learn(["a", "b"], np.full((2, 3, 5), np.nan))
    exposures.learn(["a", "b"], np.full((2, 3, 5), 1e300))
    assert all(np.isfinite(pair).all() for pair in exposures.known.values())
    poses, rng = PoseCorrections(0.1, 2.0), np.random.default_rng(0)
    for value in (0.5, np.nan):
        poses.correct(SEEN[0], lambda pose, at, v=value: np.full((len(at), 3), v, np.float32), 0.01, rng, np.zeros(3))
        np.testing.assert_allclose(poses.pose(SEEN[0]), SEEN[0].camera_to_world, atol=1e-12)


def test_a_camera_that_moved_starts_anew() -> None:
    poses = PoseCorrections(0.1, 2.0)
    poses.pose(SEEN[0])
    poses.known[SEEN[0].camera].rotation = np.array([0.01, 0.0, 0.0])
    moved = replace(SEEN[0], camera_to_world=SEEN[1].camera_to_world)
    np.testing.assert_allclose(poses.pose(moved), moved.camera_to_world)
