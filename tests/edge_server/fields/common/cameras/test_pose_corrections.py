"""Corrections of poses: they arrive, stay within bounds; a mount that is off is told from single errors."""

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.fields.common.cameras import camera_refinement_constants as tuned
from edge_server.fields.common.cameras.appearance import AppearanceEmbeddings
from edge_server.fields.common.cameras.mount_error import constant_correction
from edge_server.fields.common.cameras.pose_corrections import Leap, PoseCorrections, normal_matrix
from freshfield.geometry import Pinhole, look_at, se3, se3_inverse, so3_exp, so3_log, world_rays
from tests.edge_server.fields.small import SEEN

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


def _moved(pose: np.ndarray, by: np.ndarray) -> np.ndarray:
    return se3(so3_exp(by[3:]) @ pose[:3, :3], pose[:3, 3] + by[:3])


def _depth(view: View) -> np.ndarray:
    _, rays = world_rays(LENS, np.eye(4))
    ahead = np.asarray(view.camera_to_world)[:3, :3] @ (rays / rays[..., 2:])[..., None]
    return ((WALL_M - view.camera_to_world[2, 3]) / ahead[..., 2, 0]).astype(np.float32)


def test_the_normal_matrix_is_that_of_differences_and_a_wrong_pose_comes_back() -> None:
    view = _view()
    pose, slopes = view.camera_to_world, []
    for by in 1e-3 * np.kron(np.eye(2), pose[:3, :3].T):  # along the camera's axes, shift before rotation
        slopes.append((_wall(_moved(pose, by)) - _wall(_moved(pose, -by))).ravel() / 2e-3)
    expected = np.stack(slopes) @ np.stack(slopes).T
    found = normal_matrix(view, _depth(view))
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.06)  # a sixteenth of the pixels, central slopes
    image, errors = view.image / 255.0, []
    poses, wrong = PoseCorrections(0.3, 5.0), pose @ se3(so3_exp([0.01, -0.015, 0.02]), (0.02, -0.01, 0.015))
    poses.set_pose(view, wrong)
    np.testing.assert_allclose(poses.pose(view), wrong, atol=1e-12)
    for _ in range(60):
        now = poses.pose(view)
        steps = [1e-4 * np.eye(6)[k] for k in range(6)]  # in world axes, shift before rotation
        moved = [[_wall(_moved(now, sign * step)) for sign in (1.0, -1.0)] for step in steps]
        gradient = [(np.square(a - image).sum() - np.square(b - image).sum()) / 2e-4 for a, b in moved]
        errors.append(np.square(_wall(now) - image).mean())
        poses.descend(view, np.array(gradient), found, WALL_M / LENS.fx)
    assert errors[-1] < 0.01 * errors[0]


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
        poses, settled = PoseCorrections(0.3, 5.0), PoseCorrections(0.3, 5.0, full_steps=0.25)
        views = [_view(f"v{k:02d}", k * apart_ns) for k in range(30)]
        for each in (poses, settled):
            for view in views:
                each.pose(view)
        poses.begin(replace(views[0], camera="elsewhere"), "of another camera")
        normal = normal_matrix(views[0], _depth(views[0]))
        for _ in range(2):
            before = settled.known["v00"].shift_m
            settled.descend(views[0], np.full(6, 5.0), normal, WALL_M / LENS.fx)
        poses.descend(views[0], np.full(6, 5.0), normal, WALL_M / LENS.fx)
        sizes = [np.linalg.norm(poses.known[view.camera].shift_m) for view in views]
        assert np.count_nonzero(sizes) == moved and np.argmax(sizes) == 0
        assert not poses.known["elsewhere"].shift_m.any()
        # The second step of a view is a quarter of a full one where those get shorter after a quarter of a step.
        np.testing.assert_allclose(settled.known["v00"].shift_m - before, poses.known["v00"].shift_m / 4.0, atol=1e-12)
        again = PoseCorrections(0.3, 5.0)
        again.load(poses.meta())
        for one in (poses, again):
            one.descend(views[1], np.full(6, -3.0), normal, WALL_M / LENS.fx)
        assert again.meta() == poses.meta()
        again.forget("v07")
        assert "v07" not in again._ranks, "a carried camera forgets views for as long as it runs"


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
    normal = np.einsum("nci,ncj->ij", s, s) * weight + np.diag(prior)
    step = np.linalg.solve(normal, s.sum(axis=(0, 1)) * error * weight)
    assert np.abs(step).max() < 1.0
    for view, share in ((gray, -0.4), (SEEN[1], 0.4)):
        known = poses.known[view.camera]
        assert np.concatenate([known.rotation, known.shift_m]) == pytest.approx(share * step * scale, rel=1e-6)
    there = np.arange(lens.height * lens.width).reshape(lens.height, lens.width) % 3 > 0
    found = []
    for masked in (128, 255):
        poses = PoseCorrections(1.0, 60.0)
        poses.pose(SEEN[1])
        image = np.where(there[..., None], gray.image, np.uint8(masked))
        view = replace(gray, image=image, weight=there.astype(np.float32))
        poses.correct(view, render, 0.01, np.random.default_rng(0), np.zeros(3, np.float32))
        found.append(poses.pose(view))
    np.testing.assert_array_equal(*found, err_msg="what a mask leaves out says nothing of the pose")


def arm_poses(count: int = 40) -> list[np.ndarray]:
    """A camera led around a target, now above it, now beside, and turned about its axis."""
    turns = np.linspace(0.0, 4.0, count)
    eyes = [[0.4 * np.cos(a), 0.4 * np.sin(a), 0.3 + 0.3 * np.sin(3 * a)] for a in turns]
    return [look_at(eye, [0, 0, 0]) @ se3(so3_exp([0, 0, 2 * a]), [0, 0, 0]) for eye, a in zip(eyes, turns)]


def small(rotation_deg: list[float], shift_mm: list[float]) -> np.ndarray:
    return se3(so3_exp(np.deg2rad(rotation_deg)), 1e-3 * np.array(shift_mm))


def test_the_mounts_error_is_found_though_the_world_moved_and_poses_scatter():
    rng, given = np.random.default_rng(3), arm_poses()
    mount, world = small([0.5, -0.3, 0.2], [4.0, -2.0, 6.0]), small([0.4, 0.1, -0.5], [-9.0, 3.0, 5.0])
    noise = [small(*rng.normal(scale=[[0.05], [0.5]], size=(2, 3))) for _ in given]
    found = constant_correction(given, [world @ pose @ mount @ error for pose, error in zip(given, noise)])
    assert found is not None
    assert found.rotation_deg == pytest.approx([0.5, -0.3, 0.2], abs=0.05)
    assert found.shift_mm == pytest.approx([4.0, -2.0, 6.0], abs=0.6)
    assert found.scatter_deg == pytest.approx(0.05 * 3**0.5, rel=0.2)
    assert found.scatter_mm == pytest.approx(0.5 * 3**0.5, rel=0.3)
    assert "in common 0.6" in found.words and found.words.endswith("hand-eye calibration is off")
    scattered = [small(*rng.normal(scale=[[0.3], [5.0]], size=(2, 3))) for _ in given]
    found = constant_correction(given, [pose @ error for pose, error in zip(given, scattered)])
    assert found is not None and "no sure part in common" in found.words


@pytest.mark.stability
def test_what_cannot_be_told_is_not_said():
    mount, turning = small([0.5, 0.0, 0.0], [5.0, 0.0, 0.0]), arm_poses()
    along = [se3(turning[0][:3, :3], [0.1 * k, 0.0, 0.0]) for k in range(20)]
    found = constant_correction(along, [pose @ mount for pose in along])
    assert found is not None and np.abs(found.rotation_deg).max() < 1e-3, "it has not turned: all is the world's"
    assert constant_correction(turning[:5], [pose @ mount for pose in turning[:5]]) is None, "too few"
    wrong = [*turning[:-1], np.full((4, 4), np.nan)]
    assert constant_correction(turning, wrong) is None


@pytest.mark.parametrize(
    ("rotation_deg", "shift_mm", "away_m"),
    [
        ([-2.85, 0.2, 0.14], [-36.4, -106.8, 67.9], 2.2),  # what a minute of `redkitchen` drifted by
        ([0.0, 2.0, 0.0], [69.8, 0.0, 0.0], None),  # they add up
        ([0.0, 2.0, 0.0], [0.0, 69.8, 0.0], None),  # the one has nothing to do with the other
        ([0.0, 2.0, 0.0], [-3.0, 0.0, 0.0], None),  # nothing is so near
    ],
)
def test_a_turn_and_a_shift_that_undo_each_other_do_not_accuse_the_mount(rotation_deg, shift_mm, away_m):
    mount, given = small(rotation_deg, shift_mm), arm_poses()
    found = constant_correction(given, [pose @ mount for pose in given])
    assert found is not None and found.sure is (away_m is None)
    assert found.cancels_m == (away_m and pytest.approx(away_m, abs=0.1))


def test_an_appearance_takes_adams_steps_and_their_mean_stays_at_zero():
    """Of a constant gradient each step is as long as the rate, the first one too."""
    names, gradient = ("a", "b", "c"), np.array([[[0.3], [-0.3], [0.0]]], np.float32)
    learned = AppearanceEmbeddings(1, 0)
    first = learned.rows(names)
    for steps in (1, 2, 3):
        learned.learn(names, gradient, 1)
        moved = learned.rows(names) - first
        np.testing.assert_allclose(
            moved[:, 0], tuned.APPEARANCE_RATE * steps * np.array([-1, 1, 0]), rtol=1e-3, atol=1e-6
        )
    learned.learn(names, np.full((2, 3, 1), np.nan, np.float32), 100)
    np.testing.assert_allclose(learned.rows(names) - first, moved, err_msg="what is no number teaches nothing")
    for _ in range(2000):
        learned.learn(names, gradient, 1)
    assert np.ptp(learned.rows(names)) <= 2 * tuned.APPEARANCE_MOST + 1e-6
    assert learned.rows(names).mean() == pytest.approx(0.0, abs=1e-6)
