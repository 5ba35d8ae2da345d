"""The moving set: its motion from views, against a dense solution and in hard cases; at single instants what is
removed, and where what is seeded lies, also of cameras with depth."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import MagicMock

import numpy as np
import pytest

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.kernels.project import BASE, OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.layers import moving_set
from edge_server.fields.splat.layers.depth.body_depth import measured_frames
from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate
from edge_server.fields.splat.layers.layer_constants import FIXED, FREE, KNOTS_PER_S, MAX_AHEAD_S, STRIDE_S
from edge_server.fields.splat.layers.motion import DIFFERENCES, WINDOW, Motion, ViewRow
from edge_server.fields.splat.layers.motion_tracker import MotionTracker
from edge_server.fields.splat.layers.moving_set import MovingSet
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations
from edge_server.fields.splat.layers.plates import Plate
from edge_server.fields.splat.layers.snapshot import MovingSnapshot
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import BALL_M, RADIUS_M, ring, seen

REACH_M = 3.0


def moving(count: int = 6, start_s: float = 10.0, seed: int = 0) -> Motion:
    rng = np.random.default_rng(seed)
    motion = Motion(REACH_M, rng)
    motion.choose_anchors(rng.normal(0, 0.3, (60, 3)), np.ones(60), count, start_s)
    return motion


def row(motion: Motion, instant_s: float, truth: np.ndarray, rng, rank: int = 2, strength: float = 1e4) -> ViewRow:
    """A camera that sees ``rank`` directions of every anchor, linearized at the motion's own displacement."""
    n = truth.size
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:rank]
    seen = np.kron(np.eye(n // 3), axes.T @ axes)
    mix = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    matrix = strength * seen @ mix @ mix.T @ seen
    around = motion.at(instant_s).ravel()
    return ViewRow(instant_s, matrix, matrix @ (truth.ravel() - around), around)


def dense(motion: Motion, rows: list[ViewRow]) -> tuple[np.ndarray, np.ndarray]:
    """The reference: knots (FREE, K, 3) and covariance by a dense Cholesky factor, in the order of rows."""
    n = 3 * len(motion.anchors)
    a, b = np.zeros((WINDOW, n, WINDOW, n)), np.zeros((WINDOW, n))
    for r in rows:
        base, w = motion.weights(r.instant_s)
        whole = np.zeros(WINDOW)
        whole[base : base + 4] = w
        a += np.einsum("k,l,ij->kilj", whole, whole, r.matrix)
        b += np.outer(whole, r.vector + r.matrix @ r.around)
    steady, alike = motion._prior_weights()
    for k in range(3, WINDOW):
        d = np.zeros(WINDOW)
        d[k - 3 : k + 1] = DIFFERENCES
        a += steady * np.einsum("k,l,ij->kilj", d, d, np.eye(n))
    for k in range(1, WINDOW):
        d = np.zeros(WINDOW)
        d[k - 1 : k + 1] = -1, 1
        a += alike * np.einsum("k,l,ij->kilj", d, d, np.kron(motion._laplacian, np.eye(3)))
    size = FREE * n
    free = a[FIXED:, :, FIXED:].reshape(size, size)
    right = b[FIXED:].ravel() - a[FIXED:, :, :FIXED].reshape(size, -1) @ motion._knots[:FIXED].ravel()
    factor = np.linalg.cholesky(free)
    inverse = np.linalg.inv(factor)
    return (inverse.T @ (inverse @ right)).reshape(FREE, -1, 3), inverse.T @ inverse


def walk(t: float, count: int) -> np.ndarray:
    return np.outer(np.linspace(0.8, 1.2, count), [np.sin(t), 0.3 * np.cos(2 * t), 0.1 * t % 1.0])


@pytest.mark.parametrize("count, views", [(1, 20), (2, 3), (6, 60), (24, 40), (6, 0)])
def test_the_solution_is_that_of_a_dense_factor(count, views):
    motion, rng = moving(count), np.random.default_rng(1)
    rows = [row(motion, t, walk(t, count), rng) for t in rng.uniform(motion.oldest_s, motion.newest_s, views)]
    wanted, covariance = dense(motion, rows)
    for _ in range(3):
        assert motion.solve(rows) == 0
    deviation = np.sqrt(np.diagonal(covariance)).reshape(FREE, -1, 3)
    assert (np.abs(motion._knots[FIXED:] - wanted) / deviation).max() < 0.02


def test_rows_that_are_not_finite_or_too_old_are_left_out():
    motion, rng = moving(), np.random.default_rng(3)
    good = [row(motion, t, walk(t, 6), rng) for t in rng.uniform(motion.oldest_s, motion.newest_s, 20)]
    nan, huge = good[0].matrix.copy(), good[1].vector.copy()
    nan[3, 4], huge[0] = np.nan, np.inf
    bad = [good[0]._replace(matrix=nan), good[1]._replace(vector=huge), good[2]._replace(instant_s=np.nan)]
    late = [good[3]._replace(instant_s=t) for t in (141 / 15 - 1e-6, 152 / 15 + 1e-6)]  # of knots 139 to 151
    assert (motion.oldest_s, motion.newest_s) == pytest.approx((141 / 15, 152 / 15))
    twin = moving()
    twin.solve(good)
    assert motion.solve([*bad, *good, *late]) == 5
    np.testing.assert_array_equal(motion._knots, twin._knots)


def followed(path, seconds: float, period_s: float = 1 / 15, cameras: int = 6):
    """Errors of the displacement at each update, shown one period after the newest view; the motion."""
    motion, rng = moving(), np.random.default_rng(5)
    rows, errors, t = [], [], 10.0
    while t < 10.0 + seconds:
        t += period_s
        motion.slide(t)
        for _ in range(cameras):
            taken = t - rng.uniform(0, 1.5 * period_s)
            rows.append(row(motion, taken, path(taken), rng))
        rows = [r for r in rows if r.instant_s >= motion.oldest_s]
        motion.solve(rows)
        errors.append(np.abs(motion.at(t) - path(t)).max())
    return np.array(errors), motion


def test_a_reversal_is_followed_within_the_window():
    speed = 1.0 / REACH_M
    errors, _ = followed(lambda t: np.full((6, 3), speed * (1.0 - abs(t - 11.0))), 2.0)
    assert errors[8:14].max() < 0.01
    assert errors[-10:].max() < 0.01


def test_two_minutes_neither_drift_nor_lose_precision():
    errors, motion = followed(lambda t: walk(t, 6), 120.0, cameras=2)
    assert errors[-300:].max() < 2 * errors[100:400].max()
    assert np.isfinite(motion._knots).all()


def test_displacements_pass_through_the_knots_and_go_straight_on():
    motion = moving(1)
    motion._knots = np.random.default_rng(8).normal(size=(WINDOW, 1, 3))
    for k in range(WINDOW):
        np.testing.assert_allclose(motion.at((motion._first + k) / KNOTS_PER_S), motion._knots[k], atol=1e-9)
    last = (motion._first + WINDOW - 1) / KNOTS_PER_S
    step = motion.at(last + 0.02) - motion.at(last)
    np.testing.assert_allclose(motion.at(last + 0.04) - motion.at(last), 2 * step, atol=1e-9)
    np.testing.assert_allclose(motion.at(last) - motion.at(last - 1e-6), step * 5e-5, rtol=1e-3)


def test_shares_fall_with_the_square_of_the_distance_and_the_nearest_anchor_comes_first():
    """As 1 / (d^2 + (reach / 4)^2), where the reach is 1: the median distance to the nearest other anchor."""
    motion = moving(3)
    motion.anchors = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    motion._link()
    anchor, share = motion.attach(np.array([[0.25, 0.0, 0.0]]), 10.0)
    expected = 1.0 / (np.array([0.0625, 0.5625, 4.0625]) + 0.0625)
    assert anchor.tolist() == [[0, 1, 2]]
    np.testing.assert_allclose(share[0], expected / expected.sum(), rtol=1e-6)
    motion = moving(8)
    anchor, share = motion.attach(motion.anchors, 10.0)
    np.testing.assert_array_equal(anchor[:, 0], np.arange(8))
    np.testing.assert_allclose(share.sum(axis=1), 1.0, rtol=1e-6)
    with pytest.raises(ValueError, match="at least one point"):
        motion.choose_anchors(np.full((3, 3), np.nan), np.ones(3), 2, 10.0)


@pytest.mark.stability
@pytest.mark.parametrize("strength", [0.0, 1e-12, 1e18])
def test_views_of_one_instant_that_say_nothing_or_far_too_much(strength):
    """Of one direction only: the normal matrix is singular."""
    motion, rng = moving(), np.random.default_rng(1)
    motion.solve([row(motion, 10.0, walk(10.0, 6), rng, rank=1, strength=s) for s in (1e-12, 1e12, strength)])
    assert np.abs(motion.at(10.0)).max() < 3.0


@pytest.mark.stability
def test_anchors_that_coincide():
    motion = Motion(3.0, np.random.default_rng(0))
    for instant_s in (10.0, 12.0):
        motion.choose_anchors(np.zeros((5, 3)), np.zeros(5), 4, instant_s)
        motion.slide(instant_s + 1.0)
        motion.solve([])
        _, share = motion.attach(np.zeros((2, 3)), instant_s)
        np.testing.assert_allclose(share.sum(axis=1), 1.0, rtol=1e-6)


# --- the set at an instant --------------------------------------------------------------------------

VIEWS, INSTANT_S, POOL = ring(7), 10.0, CallerPool()
AWAY_M = np.array([9.0, 9.0, 0.5])
BOX = scene_box(VIEWS)


def _seen_from(k: int) -> tuple[FixedCamera, Observation]:
    """A camera that knows the empty scene, and its frame of the ball, with depth."""
    view, pose = VIEWS[k], VIEWS[k].camera_to_world
    axis = view.intrinsics.rays()[..., 2]
    empty, far_m = seen(view.intrinsics, pose, AWAY_M)
    image, ball_m = seen(view.intrinsics, pose)
    still_m, depth = (np.where(np.isfinite(m), m * axis, 0).astype(np.float32) for m in (far_m, ball_m))
    row = camera_rows([pose], [view.intrinsics], BOX)
    camera = FixedCamera(view, Plate(*image.shape[:2]), row=row, depth=DepthPlate.empty(*depth.shape))
    for _ in range(3):
        camera.depth.take(still_m, np.zeros(depth.shape, bool))
    camera.plate.picture = empty.astype(np.float32)
    camera.plate.known[:] = True
    return camera, Observation(INSTANT_S, view.camera, replace(view, depth=depth), (image != empty).any(axis=2))


def _set_of(places_m: np.ndarray) -> MovingSet:
    """Small Gaussians at places in meters."""
    moving = MovingSet(SplatSettings(seed_cells=32), POOL, BOX, 0)
    params = np.zeros((len(places_m), BASE), np.float32)
    params[:, :3] = BOX.normalise(places_m)
    params[:, SCALE:QUATERNION], params[:, QUATERNION], params[:, OPACITY] = np.log(0.02), 1.0, 2.0
    moving.cloud = GaussianCloud.new(params)
    if len(params):
        moving.renew_anchors(INSTANT_S)
    return moving


def _displaced_set(count: int) -> MovingSet:
    """Gaussians in the ball, whose anchors have moved by half its size since displacements were 0."""
    shift = np.array([0.3, -0.2, 0.1]) * (count > 0)
    moving = _set_of(BALL_M - shift + np.random.default_rng(1).uniform(-0.2, 0.2, (count, 3)))
    moving.motion._knots = moving.motion._knots + shift / BOX.radius_m
    return moving


def _new_m(moving: MovingSet, before: int) -> np.ndarray:
    """Where what was seeded lies."""
    assert len(moving.anchor) == len(moving)
    return moving.places(INSTANT_S)[before:] * BOX.radius_m + np.array(BOX.center_m)


@pytest.mark.parametrize(
    ("cameras", "distance_m", "bounds", "anchors"),
    [(4, 3.2, (3.0, 3.0), 48), (2, 0.9, (0.9, 0.9), 48), (5, 0.9, (5.0, 2.0), 60)],
)
def test_motion_of_few_cameras_is_bound_by_their_distance_and_has_few_anchors(cameras, distance_m, bounds, anchors):
    """Acceleration and difference of neighbors' speeds; anchors of a large foreground. Five cameras are not few."""
    moving = _set_of(np.random.default_rng(2).uniform(-0.5, 0.5, (700, 3)))
    moving.box = replace(BOX, distance_m=distance_m)
    moving.bind(2)
    moving.bind(cameras)
    assert (moving.motion.acceleration_m_per_s2, moving.motion.neighbor_m_per_s) == bounds
    moving.follow_foreground(1.0)
    moving.renew_anchors(INSTANT_S)
    assert moving.motion.anchors is not None and len(moving.motion.anchors) == anchors


@pytest.mark.parametrize(("outside", "left"), [(6, 14), (14, 0)])
def test_a_set_that_has_lost_most_of_its_gaussians_forgets_its_motion(outside: int, left: int) -> None:
    """Of 20; those outside are in sight of all cameras, beside the ball."""
    rng = np.random.default_rng(0)
    inside_m = BALL_M + rng.uniform(-0.15, 0.15, (20 - outside, 3))
    beside_m = np.array([0.0, 0.0, 1.3]) + rng.uniform(-0.05, 0.05, (outside, 3))
    moving = _set_of(np.concatenate([inside_m, beside_m]))
    cameras, frames = zip(*map(_seen_from, range(7)))
    moving.remove_outside(list(frames), {c.view.camera: c for c in cameras})
    assert len(moving) == left == len(moving.anchor)
    assert (moving.motion.anchors is None) == (left == 0)


@pytest.mark.parametrize(
    ("fresh", "followed"), [((0.5, 2.5, 3.0), (1.0, 3.0)), ((3.0,), (3.0,)), ((0.4, 1.3, 3.0), (1.0, 2.0, 3.0))]
)
def test_motion_is_followed_in_strides_that_hold_a_new_frame(fresh: tuple, followed: tuple) -> None:
    """The last frame that was followed is at 0; instants in strides."""
    kept = [SimpleNamespace(instant_s=STRIDE_S * at, fresh=at > 0) for at in (0.0, *fresh)]
    observations = MagicMock(newest_s=STRIDE_S * fresh[-1], __iter__=lambda _: iter(kept))
    strides = MotionTracker(_displaced_set(20), observations, {})._strides()
    assert strides == pytest.approx([STRIDE_S * end for end in followed])


def test_what_is_shown_is_as_much_later_than_the_newest_frame_as_motion_can_be_told_ahead() -> None:
    moving = _displaced_set(20)
    shown = MovingSnapshot.of(moving, 5_000_000_000, INSTANT_S)
    newest_ns = 5_000_000_000 + round(INSTANT_S * 1e9)
    late = [shown.ahead_s(newest_ns + later_ms * 1_000_000) for later_ms in (-100, 0, 120, 900)]
    assert late == pytest.approx([-0.1, 0.0, 0.12, MAX_AHEAD_S]) and shown.ahead_s(None) == 0.0
    then_m = moving.motion.displaced(shown.params[:, :3], shown.anchor, shown.share, INSTANT_S + 0.12)
    np.testing.assert_array_equal(shown.params_at(0.12)[:, :3], then_m)


def test_new_gaussians_lie_where_the_foreground_is_while_the_anchors_are_displaced(monkeypatch) -> None:
    """Which they are follows from the seed, the number of the draw, what is drawn, and a number of the moving set's."""
    cameras, frames = zip(*map(_seen_from, range(7)))
    moving, real, drawn = _displaced_set(20), moving_set.seed_gaussians, []
    monkeypatch.setattr(moving_set, "seed_gaussians", lambda *a: drawn.append(a[7].bit_generator.state) or real(*a))
    moving.seed_missing(list(frames), {c.view.camera: c for c in cameras})
    assert drawn == [np.random.default_rng([0, 2, 2, 6]).bit_generator.state]
    away_m = np.linalg.norm(_new_m(moving, 20) - BALL_M, axis=1)
    assert len(away_m) > 150
    assert np.median(np.abs(away_m - RADIUS_M)) < 0.15 and (away_m < 1.5 * RADIUS_M).mean() > 0.9


# --- of cameras that measure depth ------------------------------------------------------------------


def _measured(cameras: dict[str, FixedCamera], frames: list[Observation]) -> list[Observation]:
    observations = Observations()
    for o in frames:
        observations.add(o)
    return measured_frames(observations, cameras)


@pytest.mark.parametrize(("known", "scale"), [(0, 1.0), (40, 1.0), (0, 0.9)])
def test_one_frame_with_depth_seeds_the_side_of_the_ball_that_it_sees(known: int, scale: float) -> None:
    """Into an empty set, or one whose anchors are displaced; by a sensor of a wrong scale."""
    camera, frame = _seen_from(0)
    frame.view.depth[:] *= scale
    camera.depth_scale = 1.0 / scale
    moving, cameras = _displaced_set(known), {camera.view.camera: camera}
    moving.seed_at_depth(_measured(cameras, [frame]), cameras)
    places_m = _new_m(moving, known)
    off_m = np.abs(np.linalg.norm(places_m - BALL_M, axis=1) - RADIUS_M)
    assert len(places_m) > 100 and np.median(off_m) < 0.01 and off_m.max() < 0.06
    assert ((places_m - BALL_M) @ (camera.view.camera_to_world[:3, 3] - BALL_M) > -0.05).all()
    color = moving.cloud.params[known:, 11:14].mean(axis=0)
    np.testing.assert_allclose(color, frame.view.image[frame.foreground].mean(axis=0) / 255, atol=0.05)


def test_what_is_shown_rightly_is_not_seeded_again_and_the_capacity_is_kept() -> None:
    camera, frame = _seen_from(0)
    cameras = {camera.view.camera: camera}
    frames, moving = _measured(cameras, [frame]), _set_of(BALL_M + np.zeros((1440, 3)))
    frame.shown = frame.view.image / np.float32(255.0)
    moving.seed_at_depth(frames, cameras)
    assert len(moving) == 1440
    frame.shown = np.zeros_like(frame.shown)
    moving.seed_at_depth(frames, cameras)
    assert len(moving) == moving.capacity == len(moving.anchor)


def test_a_gaussian_before_which_nothing_was_measured_is_removed() -> None:
    """Between camera and ball: inside the camera's foreground, so that only depth tells."""
    camera, frame = _seen_from(0)
    near_m = BALL_M + 0.4 * (camera.view.camera_to_world[:3, 3] - BALL_M)
    moving = _set_of(np.concatenate([BALL_M + np.zeros((20, 3)), near_m + np.zeros((9, 3))]))
    # By a scale of .4, all that was measured would lie before the Gaussians.
    for scale, measured, left in ((0.4, True, 29), (1.0, False, 29), (1.0, True, 20)):
        camera.depth_scale = scale
        moving.remove_outside([frame], {camera.view.camera: camera}, measured=measured)
        assert len(moving) == left
    np.testing.assert_allclose(moving.places(INSTANT_S), BOX.normalise(BALL_M) + np.zeros((20, 3)), atol=1e-3)


@pytest.mark.stability
def test_frames_that_measured_nothing_that_moves_are_none() -> None:
    """No depth at all, holes on the ball, NaN; a frame too old."""
    (camera, frame), (other, without) = _seen_from(0), _seen_from(1)
    cameras, depth = {c.view.camera: c for c in (camera, other)}, frame.view.depth
    without = replace(without, view=replace(without.view, depth=None))
    for bad in (np.where(frame.foreground, 0, depth), np.full_like(depth, np.nan)):
        assert _measured(cameras, [replace(frame, view=replace(frame.view, depth=bad)), without]) == []
    assert _measured(cameras, [frame, replace(without, instant_s=INSTANT_S + 0.3)]) == []
    assert _measured(cameras, [frame, without]) == [frame]
