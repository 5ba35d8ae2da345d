"""Depth from frames beside a frame, against the exact depth of the ball on its plate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.scan import settings as tuned
from edge_server.fields.splat.scan.sweep import neighbors, sweep_depth
from freshfield.geometry import Pinhole, look_at, so3_exp, world_rays
from tests.edge_server.fields.scenes import seen

LENS, DISTANCE_M = Pinhole.from_fov(96, 80, 50.0), 2.4
AHEAD = world_rays(LENS, np.eye(4))[1][..., 2]


def _arc(apart_deg: float = 4.0, count: int = 5) -> tuple[list[View], NDArray[np.float64]]:
    """Views along an arc, the one in the middle first, and its exact depth, inf for the sky."""
    views, depths = [], []
    for k in range(count):
        angle = np.deg2rad(apart_deg) * (k - count // 2)
        pose = look_at(DISTANCE_M * np.array([np.cos(angle), np.sin(angle), 0.5]), (0.0, 0.0, 0.3))
        image, away_m = seen(LENS, pose)
        origin, rays = world_rays(LENS, pose)
        at = origin + rays * np.where(np.isfinite(away_m), away_m, 0.0)[..., None]
        painted = image * (0.75 + 0.25 * np.sin(at * (23.0, 29.0, 31.0)).prod(axis=-1, keepdims=True))
        views.append(View(f"{k}", painted.astype(np.uint8), pose, LENS))
        depths.append(away_m * AHEAD)
    first = count // 2
    return [views[first], *views[:first], *views[first + 1 :]], depths[first]


def _exposed(view: View, gain: float) -> View:
    return replace(view, image=np.clip(view.image * gain, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("gain", [1.0, 0.4])
def test_it_finds_the_depth_whatever_the_exposures(gain: float) -> None:
    (view, *others), truth = _arc()
    depth = sweep_depth(view, [_exposed(other, gain) for other in others], DISTANCE_M, shared_pool())
    assert depth is not None and depth.dtype == np.float32 and depth.shape == truth.shape
    there = (depth > 0) & np.isfinite(truth)
    error = np.abs(np.log(depth[there] / truth[there]))
    assert there.sum() > 0.6 * np.isfinite(truth).sum() and np.median(error) < 0.03 and (error < 0.1).mean() > 0.8


def test_neighbors_see_the_same_from_elsewhere_and_the_best_come_first() -> None:
    here = np.eye(4)

    def beside(deg: float, turned_deg: float = 0.0) -> NDArray[np.float64]:
        """On an arc around the point 2 m ahead."""
        turn, pose = so3_exp(np.array([0.0, np.deg2rad(deg), 0.0])), np.eye(4)
        pose[:3, 3] = np.array([0.0, 0.0, 2.0]) - turn @ np.array([0.0, 0.0, 2.0])
        pose[:3, :3] = turn @ so3_exp(np.array([np.deg2rad(turned_deg), 0.0, 0.0]))
        return pose

    others = [beside(0.1), beside(2.0), beside(45.0), beside(5.0), beside(5.0, 60.0), beside(-8.0), beside(20.0)]
    assert neighbors(here, others, 2.0) == [3, 5, 1, 6]
    assert len(neighbors(here, others * 3, 2.0)) == tuned.SWEPT_WITH
    assert neighbors(here, [], 2.0) == neighbors(here, [here], 2.0) == []


@pytest.mark.stability
def test_where_nothing_can_be_compared_nothing_is_found() -> None:
    """A white wall, pixels of no weight, and transparent ones."""
    views = _arc()[0]
    nothing = np.zeros(views[0].image.shape[:2], np.float32)
    for spoiled in (
        [replace(view, image=np.full_like(view.image, 255)) for view in views],
        [replace(view, weight=nothing) for view in views],
        [replace(view, image=np.dstack([view.image, nothing.astype(np.uint8)])) for view in views],
    ):
        depth = sweep_depth(spoiled[0], spoiled[1:], DISTANCE_M, shared_pool())
        assert depth is not None and (depth == 0).all()


@pytest.mark.stability
def test_pure_rotation_tells_no_depth_and_cameras_in_all_places_give_a_finite_one() -> None:
    (view, *others), _ = _arc()
    turned = [replace(view, camera_to_world=view.camera_to_world.copy()) for _ in range(4)]
    for k, each in enumerate(turned):
        each.camera_to_world[:3, :3] = so3_exp(np.array([0.0, 0.0, 0.03 * k])) @ view.camera_to_world[:3, :3]
    assert sweep_depth(view, turned, DISTANCE_M, shared_pool()) is None
    small = Pinhole.from_fov(7, 5, 50.0)
    other = replace(others[0], image=np.zeros((5, 7, 3), np.uint8), intrinsics=small)
    for distance_m in (1e-3, DISTANCE_M, 1e5):
        depth = sweep_depth(view, [other, *others], distance_m, shared_pool())
        assert depth is None or (np.isfinite(depth).all() and (depth >= 0).all())
