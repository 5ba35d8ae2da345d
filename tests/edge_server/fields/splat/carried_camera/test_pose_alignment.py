"""Alignment of a frame with a rendering, exposures in closed form, and what tells that something moves or that poses
are late."""

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera.exposures import Exposures
from edge_server.fields.splat.carried_camera.plausibility import moved_in, troubles, unturned
from edge_server.fields.splat.carried_camera.pose_alignment import Rendered, align
from freshfield.geometry import Pinhole, se3, se3_inverse, so3_exp
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
    shade = 0.5 + 0.2 * np.sin(9.0 * at[..., 0]) * np.cos(7.0 * at[..., 1])
    shade += 0.15 * np.sin(23.0 * at[..., 1] + at[..., 0])
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
    barrel = replace(WALL.scaled(4.0), distortion=(-0.2, 0.0, 0.0, 0.0))
    column = np.full((barrel.height, barrel.width), 2.0, np.float32)
    column[:, 60:160] = 1.0  # near the edge, where the lens shows it 12 pixels further in
    same = View("hand", np.zeros((*column.shape, 3), np.uint8), np.eye(4), barrel, depth=column)
    assert not moved_in(same, np.eye(4), same, np.eye(4)).any()


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


def _troubles(reported: list[np.ndarray], right: list[np.ndarray]) -> list[str]:
    """What is said of poses, 5 a second, that were corrected so."""
    poses = PoseCorrections(0.5, 5.0)
    for k, (given, corrected) in enumerate(zip(reported, right)):
        view = View(f"hand#{k}", np.zeros((4, 4, 3), np.uint8), given, LENS, k * 200_000_000)
        poses.begin(view, "hand")
        poses.set_pose(view, corrected)
    return troubles(poses)


def test_late_and_drifting_poses_are_said() -> None:
    moves = np.random.default_rng(3).normal(0.0, 0.15, (40, 3)).cumsum(axis=0)
    smooth = np.stack([np.convolve(m, np.ones(5) / 5, "same") for m in moves.T], axis=1)
    speed = np.gradient(smooth, 0.2, axis=0)
    for late_s, drift_m, words in ((0.1, 0.0, "late by some 100 ms or more"), (0.0, 0.0, None), (0.0, 0.4, "drift")):
        right = smooth + late_s * speed + np.array([drift_m, 0.0, 0.0])
        found = _troubles(*([se3(np.eye(3), at) for at in places] for places in (smooth, right)))
        assert (words is None and not found) or (words is not None and words in found[0]), found


def test_a_mount_that_is_off_is_said_live() -> None:
    poses, mount = arm_poses(), se3(so3_exp(np.deg2rad([0.0, 1.0, 0.0])), [0.0, 0.02, 0.0])
    (said,) = _troubles(poses, [pose @ mount for pose in poses])
    assert "in common 1.0" in said and said.endswith("hand-eye calibration is off") and not _troubles(poses, poses)


# --- exposures --------------------------------------------------------------------------------------

R = np.random.default_rng(3).uniform(0.1, 0.9, (400, 3))


def _sums(exposures: Exposures, camera: str, image: np.ndarray) -> np.ndarray:
    """What a step sums: (3, MOMENTS)."""
    gain, bias = exposures.of(camera)
    t = (image - bias) / gain
    return np.stack([part.sum(axis=0) for part in (np.ones_like(R), R, R * R, t, R * t)], axis=1)


def test_gain_and_bias_are_found_and_errors_count_as_in_the_image() -> None:
    exposures, gain, bias = Exposures(), np.array([1.3, 0.8, 1.0]), np.array([0.05, -0.1, 0.2])
    image = gain * R + bias
    for _ in range(40):
        exposures.learn("a", _sums(exposures, "a", image))
    found = exposures.of("a")
    # The damped least squares, solved as a matrix.
    for c in range(3):
        normal = np.array([[np.mean(R[:, c] ** 2), R[:, c].mean()], [R[:, c].mean(), 1.0]])
        right = [np.mean(R[:, c] * image[:, c]) + tuned.TOWARDS_ONE, image[:, c].mean()]
        expected = np.linalg.solve(normal + tuned.TOWARDS_ONE * np.eye(2), right)
        np.testing.assert_allclose(found[:, c], expected, atol=1e-5)
    assert np.abs(found[0] * R + found[1] - image).max() < 0.05
    row = exposures.row("a")
    np.testing.assert_allclose(row, [*found[0], *found[1], np.square(found[0]).mean()], rtol=1e-6)
    np.testing.assert_array_equal(exposures.row("unknown"), [1, 1, 1, 0, 0, 0, 1])


def test_the_gauge_is_mean_gain_one_and_mean_bias_zero_and_between_is_between() -> None:
    exposures = Exposures()
    exposures.load({"a": [[0.8] * 3, [0.1] * 3], "b": [[1.8] * 3, [0.0] * 3]})
    exposures.center()
    a, b = exposures.of("a"), exposures.of("b")
    np.testing.assert_allclose(a[0] * b[0], 1.0)
    np.testing.assert_allclose(a[0] / b[0], 0.8 / 1.8)
    np.testing.assert_allclose(a[1], -b[1])
    np.testing.assert_allclose(exposures.between({"a": 0.5, "b": 0.5}), [[1.0] * 3, [0.0] * 3], atol=1e-12)
    np.testing.assert_allclose(exposures.between({"b": 1.0}), b)
    np.testing.assert_array_equal(exposures.between({}), [[1.0] * 3, [0.0] * 3])
    again = Exposures()
    again.load(exposures.meta())
    assert again.meta() == exposures.meta()


@pytest.mark.stability
def test_no_sums_lead_out_of_bounds() -> None:
    exposures, nothing = Exposures(), np.zeros((3, 5))
    exposures.center()
    for bad in (nothing, np.full((3, 5), np.nan), np.full((3, 5), np.inf)):
        exposures.learn("a", bad)
        assert not exposures.known
    black, blown = _sums(exposures, "a", np.zeros_like(R)), _sums(exposures, "a", np.full_like(R, 50.0))
    for sums in (black, blown, np.full((3, 5), 1e30), -np.full((3, 5), 1e-30)):
        for _ in range(20):
            exposures.learn("a", sums)
            exposures.center()
        gain, bias = exposures.of("a")
        assert gain.min() >= tuned.GAINS[0] and gain.max() <= tuned.GAINS[1] and np.abs(bias).max() <= tuned.MOST_BIAS
