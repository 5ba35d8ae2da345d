"""Alignment of a frame with a rendering, and what tells that something moves or that poses are late."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edge_server.fields import View
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from edge_server.fields.splat.carried_camera import settings as tuned
from edge_server.fields.splat.carried_camera.plausibility import moved_in, troubles, unturned
from edge_server.fields.splat.carried_camera.tracking import Rendered, align, gray
from freshfield.geometry import Pinhole, se3_inverse, so3_exp
from tests.edge_server.fields.common.cameras.test_pose_corrections import arm_poses
from tests.edge_server.fields.splat.carried_camera.carried import LENS

WALL = Pinhole.from_fov(160, 120, 60.0)


def _wall(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Brightness and depth of a textured, wavy wall 2 m ahead."""
    rays = WALL.rays() @ pose[:3, :3].T
    far = np.full(rays.shape[:2], 2.0)
    for _ in range(8):
        at = pose[:3, 3] + rays * far[..., None]
        far = far + (2.0 + 0.2 * np.sin(2.0 * at[..., 0]) - at[..., 2]) / rays[..., 2]
    at = pose[:3, 3] + rays * far[..., None]
    shade = (
        0.5 + 0.2 * np.sin(9.0 * at[..., 0]) * np.cos(7.0 * at[..., 1]) + 0.15 * np.sin(23.0 * at[..., 1] + at[..., 0])
    )
    return shade.astype(np.float32), (far * WALL.rays()[..., 2]).astype(np.float32)


def _off_px(true: np.ndarray, found: np.ndarray, depth: np.ndarray) -> float:
    """How far apart the two poses place what is seen, pixels, on average."""
    points = WALL.rays() / WALL.rays()[..., 2:] * depth[..., None]
    places = []
    for pose in (true, found):
        at = points @ se3_inverse(pose)[:3, :3].T + se3_inverse(pose)[:3, 3]
        places.append(WALL.fx * at[..., :2] / at[..., 2:])
    return float(np.linalg.norm(places[0] - places[1], axis=-1).mean())


@pytest.mark.parametrize(("deg", "shift_m", "gain"), [(0.0, 0.0, 1.0), (1.0, 0.02, 1.0), (2.0, 0.04, 1.2)])
def test_a_frame_is_found_where_it_was_taken(monkeypatch, deg: float, shift_m: float, gain: float) -> None:
    true = np.eye(4)
    true[:3, :3] = so3_exp(np.deg2rad(deg) * np.array([0.6, -0.7, 0.4]))
    true[:3, 3] = shift_m * np.array([0.6, 0.6, 0.5])
    shade, depth = _wall(np.eye(4))
    shown, off_px = Rendered(np.eye(4), WALL, shade, depth, np.ones_like(shade)), []
    for prior in (tuned.PRIOR_ERROR, 1e-2 * tuned.PRIOR_ERROR):
        monkeypatch.setattr(tuned, "PRIOR_ERROR", prior)
        found = align(shown, gain * _wall(true)[0], np.eye(4))
        assert found.overlap > 0.8 and found.agreeing > 0.95
        off_px.append(_off_px(true, found.pose, depth))
    given_px = _off_px(true, np.eye(4), depth)
    assert off_px[0] < 0.02 + 0.5 * given_px and off_px[1] < 0.02 + 0.12 * given_px


@pytest.mark.stability
@pytest.mark.parametrize("what", ["dark", "nothing rendered", "no surface", "another picture"])
def test_without_agreement_the_pose_stays_near_and_is_finite(what: str) -> None:
    shade, depth = _wall(np.eye(4))
    opacity = np.zeros_like(shade) if what == "nothing rendered" else np.ones_like(shade)
    depth = np.zeros_like(depth) if what == "no surface" else depth
    frame = np.random.default_rng(1).random(shade.shape).astype(np.float32)
    found = align(Rendered(np.eye(4), WALL, shade, depth, opacity), 0 * shade if what == "dark" else frame, np.eye(4))
    assert np.isfinite(found.pose).all() and np.linalg.norm(found.pose[:3, 3]) < 0.3
    assert found.agreeing < 0.9


def test_what_has_come_is_told_from_what_was_not_seen_before() -> None:
    there, views = np.eye(4), []
    there[:3, :3], there[:3, 3] = so3_exp(np.array([0.0, 0.1, 0.0])), [0.1, 0.0, 0.05]
    for pose in (np.eye(4), there):
        image = np.zeros((WALL.height, WALL.width, 3), np.uint8)
        views.append(View("hand", image, pose, WALL, depth=_wall(pose)[1]))
    before, now = views
    assert not moved_in(now, there, before, np.eye(4)).any()
    depth = now.depth.copy()
    depth[40:80, 60:110] = 1.0  # somebody stands in front
    found = moved_in(replace(now, depth=depth), there, before, np.eye(4))
    assert found[45:75, 65:105].mean() > 0.95 and found[:30].mean() < 0.02
    assert not moved_in(now, there, replace(before, depth=depth), np.eye(4))[:, :40].any()


@pytest.mark.stability
@pytest.mark.parametrize(
    ("turn_deg", "shift_m", "reported_m", "contradicted"),
    [
        ([0.0, -8.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0], True),  # along the shift, but against its direction
        ([4.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0], True),
        ([0.0, 4.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], True),
        ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.0, 0.0], False),  # it slides, whatever the unit of its poses
        ([0.0, 0.0, 0.0], [0.0, -0.1, 0.05], [0.0, -100.0, 50.0], False),
        ([0.0, 0.0, 0.0], [0.1, 0.0, 0.0], [0.1, 0.02, 0.0], False),  # as a tracker errs
        ([0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0], False),
    ],
)
def test_pictures_contradict_poses_without_rotation_and_no_camera_that_slides(
    turn_deg, shift_m, reported_m, contradicted: bool
) -> None:
    true, reported = np.eye(4), np.eye(4)
    true[:3, :3], true[:3, 3], reported[:3, 3] = so3_exp(np.deg2rad(turn_deg)), shift_m, reported_m
    images = [np.repeat((255 * _wall(pose)[0][..., None]).astype(np.uint8), 3, axis=2) for pose in (np.eye(4), true)]
    before, now = (View("hand", each, pose, WALL) for each, pose in zip(images, (np.eye(4), reported)))
    assert unturned(before, now) is contradicted
    assert not unturned(before, replace(now, camera_to_world=true)) or not any(turn_deg), "it reports that it turns"
    assert not unturned(before, replace(now, image=np.full_like(images[0], 90))), "nothing to follow"


def test_late_and_drifting_poses_are_said() -> None:
    times, moves = np.arange(40) / 5.0, np.random.default_rng(3).normal(0.0, 0.15, (40, 3)).cumsum(axis=0)
    smooth = np.stack([np.convolve(m, np.ones(5) / 5, "same") for m in moves.T], axis=1)
    for late_s, drift_m, words in ((0.1, 0.0, "late by some 100 ms or more"), (0.0, 0.0, None), (0.0, 0.4, "drift")):
        poses, speed = PoseCorrections(0.5, 5.0), np.gradient(smooth, times, axis=0)
        for k, t in enumerate(times):
            pose = np.eye(4)
            pose[:3, 3] = smooth[k]
            view = View(f"hand#{k}", np.zeros((4, 4, 3), np.uint8), pose, LENS, round(t * 1e9))
            poses.begin(view, "hand")
            right = pose.copy()
            right[:3, 3] += late_s * speed[k] + np.array([drift_m, 0.0, 0.0])
            poses.set_pose(view, right)
        found = troubles(poses)
        assert (words is None and not found) or (words is not None and words in found[0]), found


def test_a_mount_that_is_off_is_said_live() -> None:
    mount, poses, still = np.eye(4), PoseCorrections(0.5, 5.0), PoseCorrections(0.5, 5.0)
    mount[:3, :3], mount[:3, 3] = so3_exp(np.deg2rad([0.0, 1.0, 0.0])), [0.0, 0.02, 0.0]
    for k, given in enumerate(arm_poses()):
        view = View(f"hand#{k}", np.zeros((4, 4, 3), np.uint8), given, LENS, k * 10**8)
        for each, error in ((poses, mount), (still, np.eye(4))):
            each.begin(view, "hand")
            each.set_pose(view, given @ error)
    (said,) = troubles(poses)
    assert "in common 1.0" in said and said.endswith("hand-eye calibration is off") and not troubles(still)


def test_gray_is_that_of_opencv() -> None:
    image = np.random.default_rng(0).integers(0, 256, (6, 5, 4)).astype(np.uint8)
    np.testing.assert_allclose(255 * gray(image), cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2GRAY), atol=1.0)
