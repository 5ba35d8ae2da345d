"""The moving set at single instants: what is removed, and where what is seeded lies; also of cameras with depth."""

from __future__ import annotations

from dataclasses import replace

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
from edge_server.fields.splat.layers.moving_set import MovingSet
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations
from edge_server.fields.splat.layers.plates import Plate
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import BALL_M, RADIUS_M, ring, seen

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
    camera = FixedCamera(view, Plate(*image.shape[:2], POOL), row=row, depth=DepthPlate.empty(*depth.shape))
    for _ in range(3):
        camera.depth.take(still_m, np.zeros(depth.shape, bool), POOL)
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
    ("cameras", "distance_m", "bounds"), [(4, 3.2, (3.0, 3.0)), (2, 0.9, (0.9, 0.9)), (5, 0.9, (5.0, 2.0))]
)
def test_motion_of_few_cameras_is_bound_by_their_distance(cameras, distance_m, bounds) -> None:
    """Acceleration and difference of neighbors' speeds; five cameras are not few."""
    moving = MovingSet(SplatSettings(), POOL, replace(BOX, distance_m=distance_m), 0)
    moving.bind(2)
    moving.bind(cameras)
    assert (moving.motion.acceleration_m_per_s2, moving.motion.neighbor_m_per_s) == bounds


@pytest.mark.parametrize(("cameras", "anchors"), [(4, 48), (5, 60)])
def test_anchors_grow_with_the_foreground_up_to_a_bound_for_few_cameras(cameras: int, anchors: int) -> None:
    moving = _set_of(np.random.default_rng(2).uniform(-0.5, 0.5, (700, 3)))
    moving.bind(cameras)
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


def test_new_gaussians_lie_where_the_foreground_is_while_the_anchors_are_displaced(monkeypatch) -> None:
    """Which they are follows from the seed, the number of the draw, what is drawn, and a number of the moving set's."""
    cameras, frames = zip(*map(_seen_from, range(7)))
    moving, real, drawn = _displaced_set(20), moving_set.seed_gaussians, []
    monkeypatch.setattr(moving_set, "seed_gaussians", lambda *a: drawn.append(a[7].bit_generator.state) or real(*a))
    moving.seed_missing(list(frames), {c.view.camera: c for c in cameras})
    assert drawn == [np.random.default_rng([0, 2, 2, 6]).bit_generator.state]
    away_m = np.linalg.norm(_new_m(moving, 20) - BALL_M, axis=1)
    assert len(away_m) > 50
    assert np.median(np.abs(away_m - RADIUS_M)) < 0.15 and (away_m < 1.5 * RADIUS_M).mean() > 0.9


# --- of cameras that measure depth ------------------------------------------------------------------


def _measured(cameras: dict[str, FixedCamera], frames: list[Observation]) -> list[Observation]:
    observations = Observations()
    for o in frames:
        observations.add(o)
    return measured_frames(observations, cameras, POOL)


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
