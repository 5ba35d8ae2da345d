"""Pose errors of cameras: learned if enabled, harmless where there are none, else absent."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from freshfield.geometry import so3_exp, so3_log
from tests.edge_server.fields.small import SEEN, same_state, score, small


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


@pytest.mark.slow  # 7 s
def test_poses_are_improved() -> None:
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


def test_corrections_repeat_themselves_and_resume_bit_for_bit() -> None:
    refined = {"refine_m": 0.05, "refine_deg": 2.0}
    views = _displaced(SEEN, 0.02, 1.0)
    a, b = small("tensorf", **refined), small("tensorf", threads=1, **refined)
    for field in (a, b):
        field.fit(views, Budget(steps=120))
    c = small("tensorf", **refined)
    c.load_state(a.state())
    for field in (a, b, c):
        field.fit(views, Budget(steps=15))
    same_state(a, b)
    same_state(a, c)
    assert a._cameras.meta() == b._cameras.meta() == c._cameras.meta()
    assert any(abs(np.array(t)).max() > 0 for _, t, *_ in a._cameras.meta()["poses"].values())


def test_what_is_not_finite_or_says_nothing_changes_nothing_and_a_camera_that_moved_starts_anew() -> None:
    poses, rng = PoseCorrections(0.1, 2.0), np.random.default_rng(0)
    for value in (0.5, np.nan):
        poses.correct(SEEN[0], lambda pose, at, v=value: np.full((len(at), 3), v, np.float32), 0.01, rng, np.zeros(3))
        np.testing.assert_allclose(poses.pose(SEEN[0]), SEEN[0].camera_to_world, atol=1e-12)
    poses.known[SEEN[0].camera].rotation = np.array([0.01, 0.0, 0.0])
    moved = replace(SEEN[0], camera_to_world=SEEN[1].camera_to_world)
    np.testing.assert_allclose(poses.pose(moved), moved.camera_to_world, err_msg="it starts anew")


def test_a_step_by_rendered_colors_is_gauss_newtons_and_its_mean_is_taken_from_all() -> None:
    gray = replace(SEEN[0], image=np.full_like(SEEN[0].image, 128))
    poses, lens, given = PoseCorrections(1.0, 60.0), gray.intrinsics, gray.camera_to_world
    poses.pose(SEEN[1])
    scale = np.array([1.0 / lens.fx] * 3 + [0.01] * 3)

    def slopes(points: np.ndarray) -> np.ndarray:
        """Of three colors by six parameters, per pixel's worth of motion."""
        return 0.05 * np.sin(points[:, :1, None] * np.arange(1, 4)[:, None] + points[:, 1:, None] * np.arange(6))

    def render(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
        moved = np.concatenate([so3_log(pose[:3, :3] @ given[:3, :3].T), pose[:3, 3] - given[:3, 3]])
        return 0.52 + slopes(points) @ (moved / scale)

    poses.correct(gray, render, 0.01, np.random.default_rng(0), np.zeros(3, np.float32))
    rng = np.random.default_rng(0)
    s = slopes(np.stack([rng.integers(0, side, 384) for side in (lens.width, lens.height)], axis=-1) + 0.5)
    error = 0.52 - 128 / 255
    weight = 1.0 / (1.0 + 3.0 * error**2 / 0.15**2) / 384
    prior = 0.01 / (np.array([np.deg2rad(60.0)] * 3 + [1.0] * 3) / scale) ** 2
    step = np.linalg.solve(
        np.einsum("nci,ncj->ij", s, s) * weight + np.diag(prior), s.sum(axis=(0, 1)) * error * weight
    )
    assert np.abs(step).max() < 1.0
    for view, share in ((gray, -0.4), (SEEN[1], 0.4)):
        known = poses.known[view.camera]
        assert np.concatenate([known.rotation, known.shift_m]) == pytest.approx(share * step * scale, rel=1e-6)
