"""Depth from frames beside a frame, and discs from an image with depth."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera.frame_stereo import neighbors, sweep_depth
from edge_server.fields.splat.carried_camera.seeds_on_depth import discs, filled, quadtree, usable_depth
from edge_server.fields.splat.kernels.project import BASE, COLOR, QUATERNION, SCALE
from freshfield.geometry import Pinhole, look_at, quaternion_to_matrix, so3_exp, world_rays
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


@pytest.mark.parametrize("gain", [1.0, 0.4])
def test_it_finds_the_depth_whatever_the_exposures(gain: float) -> None:
    (view, *others), truth = _arc()
    exposed = [replace(other, image=np.clip(other.image * gain, 0, 255).astype(np.uint8)) for other in others]
    depth = sweep_depth(view, exposed, DISTANCE_M, shared_pool())
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
    assert neighbors(here, [beside(5.0, 20.0), beside(5.0)], 2.0) == [1, 0], "what faces the same way"
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
    other = replace(others[0], image=np.zeros((5, 7, 3), np.uint8), intrinsics=Pinhole.from_fov(7, 5, 50.0))
    for distance_m in (1e-3, DISTANCE_M, 1e5):
        depth = sweep_depth(view, [other, *others], distance_m, shared_pool())
        assert depth is None or (np.isfinite(depth).all() and (depth >= 0).all())


DISC_LENS = Pinhole(50, 38, 40.0, 40.0, 25.0, 19.0, (-0.05, 0.01, 0.0, 0.0))


def test_leaves_cover_what_is_wanted_once_and_are_small_where_there_is_detail() -> None:
    rng = np.random.default_rng(1)
    color = np.full((38, 50, 3), 0.5, np.float32)
    color[:16, :16] = rng.random((16, 16, 3))
    wanted = np.ones((38, 50), bool)
    wanted[20:, 30:] = False
    leaves = quadtree(color, wanted, (16, 8, 4), 0.06)
    covered = np.zeros((48, 64), int)
    for row, column, side in zip(*leaves):
        covered[row : row + side, column : column + side] += 1
    assert (covered[:38, :50][wanted] == 1).all()
    assert covered.sum() < 1.15 * wanted.sum() + 16 * 4 * 40 and (covered[24:38, 32:50] == 0).all()
    sides = {(int(r), int(c)): int(s) for r, c, s in zip(*leaves)}
    assert sides[0, 0] == 4 and sides[0, 16] == 16
    assert len(quadtree(color, np.zeros_like(wanted), (16, 8, 4), 0.06).row) == 0


@pytest.mark.parametrize("slope", [0.0, 0.7, -0.7])
def test_discs_lie_flat_on_the_surface(slope: float) -> None:
    rays, pose = DISC_LENS.rays(), look_at((0.3, -2.0, 0.5), (0.0, 0.0, 0.2))
    depth = (2.0 / (1.0 - slope * rays[..., 0] / rays[..., 2])).astype(np.float32)  # z = 2 + slope x, camera axes
    color = np.broadcast_to(np.array([0.2, 0.5, 0.7], np.float32), (*depth.shape, 3)).copy()
    leaves = quadtree(color, np.ones(depth.shape, bool), (4,), 1.0)
    params = discs(color, depth, leaves, DISC_LENS, pose, 0.6, np.full(len(leaves.row), 0.8, np.float32))
    assert params.shape == (len(leaves.row), BASE) and np.isfinite(params).all()
    inside = (leaves.row > 4) & (leaves.row < 30) & (leaves.column > 4) & (leaves.column < 42)
    local = (params[inside, :3] - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(local[:, 2], 2.0 + slope * local[:, 0], rtol=0.05)
    np.testing.assert_allclose(DISC_LENS.project(local)[:, 0], leaves.column[inside] + 2.0, atol=0.01)
    axes = quaternion_to_matrix(params[inside, QUATERNION : QUATERNION + 4])
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0) @ pose[:3, :3].T
    assert np.abs(axes[:, :, 2] @ normal).min() > 0.98
    sizes = np.exp(params[inside, SCALE : SCALE + 3])
    np.testing.assert_allclose(sizes[:, 0], 0.6 * 4 * local[:, 2] / DISC_LENS.fx, rtol=1e-4)
    np.testing.assert_allclose(sizes[:, 2], tuned.FLATNESS * sizes[:, 0], rtol=1e-4)
    assert (sizes[:, 1] >= sizes[:, 0] * 0.999).all()
    if slope:  # stretched along the tilt, which is the x axis
        assert np.abs(axes[:, :, 1] @ pose[:3, :3] @ [1.0, 0.0, 0.0]).min() > 0.7
    np.testing.assert_allclose(params[:, COLOR:BASE], color[0, :1] * np.ones((len(params), 1)), atol=1e-5)


def test_depth_at_jumps_is_of_no_surface_and_holes_take_the_nearest() -> None:
    depth = np.full((20, 20), 1.0, np.float32)
    depth[:, 10:] = 3.0
    kept = usable_depth(depth)
    assert (kept[:, 9:11] == 0).all() and (kept[:, :8] == 1.0).all() and (kept[:, 12:] == 3.0).all()
    whole = filled(kept)
    assert set(np.unique(whole)) == {1.0, 3.0} and (whole[:, 12:] == 3.0).all()
    nothing = np.zeros((5, 5), np.float32)
    np.testing.assert_array_equal(filled(nothing), nothing)
    depth[4, 4] = 0.0
    assert usable_depth(depth)[4, 4] == 0.0 and usable_depth(depth)[4, 6] == 1.0


@pytest.mark.stability
def test_depth_that_cannot_be_is_none() -> None:
    for value in (np.nan, np.inf, -1.0, 0.0, 1e-30, 1e30):
        some = np.full((12, 16), 2.0, np.float32)
        some[:, 3] = value
        found = usable_depth(some)
        assert found is not None and (found[:, 3] == 0.0).all() and (found[:, 8:] == 2.0).all()
        assert usable_depth(np.full((12, 16), value, np.float32)) is None
    y, x = np.indices((12, 16))
    assert usable_depth(np.where((x + y) % 2, 1.0, 5.0).astype(np.float32)) is None  # all jumps
    assert usable_depth(np.ones((4, 64), np.float32)) is None and usable_depth(None) is None
