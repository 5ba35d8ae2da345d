"""The moving set of cameras that measure depth, at single instants: what is seeded and removed, and where."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.layers.depth.body_depth import measured_frames
from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations
from edge_server.fields.splat.layers.plates import Plate
from tests.edge_server.fields.scenes import BALL_M, RADIUS_M, ring, seen
from tests.edge_server.fields.splat.layers.test_moving_set import set_of

VIEWS, INSTANT_S = ring(3), 10.0
AWAY_M = np.array([9.0, 9.0, 0.5])
BOX = scene_box(VIEWS)


def _seen_from(k: int, with_depth: bool = True) -> tuple[FixedCamera, Observation]:
    """A camera of the empty scene, and its frame of the ball."""
    view, pose = VIEWS[k], VIEWS[k].camera_to_world
    axis = view.intrinsics.rays()[..., 2]
    empty, far_m = seen(view.intrinsics, pose, AWAY_M)
    image, ball_m = seen(view.intrinsics, pose)
    still_m, depth = (np.where(np.isfinite(m), m * axis, 0).astype(np.float32) for m in (far_m, ball_m))
    row = camera_rows([pose], [view.intrinsics], BOX)
    camera = FixedCamera(view, Plate(*image.shape[:2], CallerPool()), row=row, depth=DepthPlate.empty(*depth.shape))
    for _ in range(3):
        camera.depth.take(still_m, np.zeros(depth.shape, bool), CallerPool())
    camera.plate.picture = empty.astype(np.float32)
    camera.plate.known[:] = True
    frame = replace(view, depth=depth if with_depth else None)
    return camera, Observation(INSTANT_S, view.camera, frame, (image != empty).any(axis=2))


def _still_m(camera: FixedCamera) -> np.ndarray:
    assert camera.depth is not None
    inverse = camera.depth.medians(CallerPool())
    return np.where(inverse > 0, 1.0 / np.maximum(inverse, 1e-6), 0).astype(np.float32)


def _measured(cameras: dict[str, FixedCamera], frames: list[Observation]) -> list[Observation]:
    observations = Observations()
    for o in frames:
        observations.add(o)
    return measured_frames(observations, cameras, CallerPool())


@pytest.mark.parametrize(("known", "scale"), [(0, 1.0), (40, 1.0), (0, 0.9)])
def test_one_frame_with_depth_seeds_the_side_of_the_ball_that_it_sees(known: int, scale: float) -> None:
    """Into an empty set, or one whose anchors have moved since displacements were 0; by a sensor of a wrong scale."""
    camera, frame = _seen_from(0)
    assert frame.view.depth is not None
    frame.view.depth[:] *= scale
    camera.depth_scale = 1.0 / scale
    shift = np.array([0.3, -0.2, 0.1]) * (known > 0)
    moving = set_of(BALL_M - shift + np.random.default_rng(1).uniform(-0.2, 0.2, (known, 3)), BOX)
    moving.motion._knots = moving.motion._knots + shift / BOX.radius_m
    cameras = {camera.view.camera: camera}
    moving.seed_at_depth(_measured(cameras, [frame]), cameras)
    places_m = moving.places(INSTANT_S)[known:] * BOX.radius_m + np.array(BOX.center_m)
    assert len(places_m) > 100 and len(moving.anchor) == len(moving)
    off_m = np.abs(np.linalg.norm(places_m - BALL_M, axis=1) - RADIUS_M)
    assert np.median(off_m) < 0.01 and off_m.max() < 0.06
    towards = (places_m - BALL_M) @ (camera.view.camera_to_world[:3, 3] - BALL_M)
    assert (towards > -0.05).all()
    error = np.abs(
        moving.cloud.params[known:, 11:14].mean(axis=0) - frame.view.image[frame.foreground].mean(axis=0) / 255
    )
    assert error.max() < 0.05


def test_what_is_shown_rightly_is_not_seeded_again_and_the_capacity_is_kept() -> None:
    camera, frame = _seen_from(0)
    cameras = {camera.view.camera: camera}
    frames, moving = _measured(cameras, [frame]), set_of(BALL_M + np.zeros((1440, 3)), BOX)
    frame.shown = frame.view.image / np.float32(255.0)
    moving.seed_at_depth(frames, cameras)
    assert len(moving) == 1440
    frame.shown = np.zeros_like(frame.shown)
    moving.seed_at_depth(frames, cameras)
    assert len(moving) == moving.capacity == len(moving.anchor)


def test_a_gaussian_before_which_nothing_was_measured_is_removed() -> None:
    """Between camera and ball: inside the camera's foreground, so that only depth tells."""
    camera, frame = _seen_from(0)
    eye_m = camera.view.camera_to_world[:3, 3]
    near_m = BALL_M + 0.4 * (eye_m - BALL_M)
    moving = set_of(np.concatenate([BALL_M + np.zeros((20, 3)), near_m + np.zeros((9, 3))]), BOX)
    cameras = {camera.view.camera: camera}
    camera.depth_scale = 0.4  # all that was measured would lie before the Gaussians
    moving.remove_outside([frame], cameras, measured=True)
    assert len(moving) == 29
    camera.depth_scale = 1.0
    moving.remove_outside([frame], cameras)
    assert len(moving) == 29
    moving.remove_outside([frame], cameras, measured=True)
    assert len(moving) == 20
    np.testing.assert_allclose(moving.places(INSTANT_S), BOX.normalise(BALL_M) + np.zeros((20, 3)), atol=1e-3)


@pytest.mark.stability
def test_frames_that_measured_nothing_that_moves_are_none() -> None:
    """No depth at all, holes on the ball, NaN, the plate's depth on the ball; a frame too old."""
    (camera, frame), (other, without) = _seen_from(0), _seen_from(1, with_depth=False)
    cameras = {c.view.camera: c for c in (camera, other)}
    depth = frame.view.depth
    assert depth is not None
    assert _measured(cameras, [without]) == []
    for bad in (np.where(frame.foreground, 0, depth), np.full_like(depth, np.nan), _still_m(camera)):
        assert _measured(cameras, [replace(frame, view=replace(frame.view, depth=bad)), without]) == []
    camera.plate.known[:], camera.depth = False, DepthPlate.empty(*depth.shape)  # nothing tells what stands still
    assert _measured(cameras, [replace(frame, body_m=None), without]) == []
    camera.plate.known[:] = True
    late = replace(without, instant_s=INSTANT_S + 0.3)
    assert _measured(cameras, [frame, late]) == []
    assert _measured(cameras, [frame, without]) == [frame]
