"""The moving set at single instants: what is removed, and where what is seeded lies."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import SceneBox, scene_box
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.densification import GaussianCloud
from edge_server.fields.splat.kernels.project import BASE, OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.layers.moving_set import MovingSet
from edge_server.fields.splat.layers.observations import FixedCamera, Observation
from edge_server.fields.splat.layers.plates import Plate
from edge_server.fields.splat.settings import SplatSettings
from tests.edge_server.fields.scenes import picture, ring

VIEWS, INSTANT_S = ring(7), 10.0
BALL_M, RADIUS_M = np.array([0.0, 0.0, 0.5]), 0.5
AWAY_M = np.array([9.0, 9.0, 0.5])
BOX = scene_box(VIEWS)
CAMERAS = {
    v.camera: FixedCamera(
        v, Plate(*v.image.shape[:2], CallerPool()), row=camera_rows([v.camera_to_world], [v.intrinsics], BOX)
    )
    for v in VIEWS
}


def _frames() -> list[Observation]:
    """The ball, in front of the empty scene."""
    frames = []
    for v in VIEWS:
        empty = picture(v.intrinsics, v.camera_to_world, AWAY_M)
        ball = cv2.absdiff(v.image, empty).max(axis=2) > 20
        frames.append(Observation(INSTANT_S, v.camera, v, ball))
    return frames


def set_of(places_m: np.ndarray, box: SceneBox = BOX) -> MovingSet:
    """Small Gaussians at places in meters."""
    moving = MovingSet(SplatSettings(seed_cells=32), CallerPool(), box, 0)
    params = np.zeros((len(places_m), BASE), np.float32)
    params[:, :3] = box.normalise(places_m)
    params[:, SCALE:QUATERNION], params[:, QUATERNION], params[:, OPACITY] = np.log(0.02), 1.0, 2.0
    moving.cloud = GaussianCloud.new(params)
    if len(params):
        moving.renew_anchors(INSTANT_S)
    return moving


@pytest.mark.parametrize(
    ("cameras", "distance_m", "bounds"), [(4, 3.2, (3.0, 3.0)), (2, 0.9, (0.9, 0.9)), (5, 0.9, (5.0, 2.0))]
)
def test_motion_of_few_cameras_is_bound_by_their_distance(
    cameras: int, distance_m: float, bounds: tuple[float, float]
) -> None:
    """Acceleration and difference of neighbors' speeds; five cameras are not few."""
    moving = MovingSet(SplatSettings(), CallerPool(), replace(BOX, distance_m=distance_m), 0)
    moving.bind(2)
    moving.bind(cameras)
    assert (moving.motion.acceleration_m_per_s2, moving.motion.neighbor_m_per_s) == bounds


@pytest.mark.parametrize(("cameras", "anchors"), [(4, 48), (5, 60)])
def test_anchors_grow_with_the_foreground_up_to_a_bound_for_few_cameras(cameras: int, anchors: int) -> None:
    moving = set_of(np.random.default_rng(2).uniform(-0.5, 0.5, (700, 3)))
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
    moving = set_of(np.concatenate([inside_m, beside_m]))
    moving.remove_outside(_frames(), CAMERAS)
    assert len(moving) == left == len(moving.anchor)
    assert (moving.motion.anchors is None) == (left == 0)


def test_new_gaussians_lie_where_the_foreground_is_while_the_anchors_are_displaced() -> None:
    """The anchors have moved by half the ball's size since the instant at which displacements were 0."""
    shift = np.array([0.3, -0.2, 0.1]) / BOX.radius_m
    moving = set_of(BALL_M - shift * BOX.radius_m + np.random.default_rng(1).uniform(-0.2, 0.2, (20, 3)))
    moving.motion._knots = moving.motion._knots + shift
    before = len(moving)
    moving.seed_missing(_frames(), CAMERAS)
    new_m = moving.places(INSTANT_S)[before:] * BOX.radius_m + np.array(BOX.center_m)
    assert len(new_m) > 50
    away_m = np.linalg.norm(new_m - BALL_M, axis=1)
    assert np.median(np.abs(away_m - RADIUS_M)) < 0.15 and (away_m < 1.5 * RADIUS_M).mean() > 0.9
