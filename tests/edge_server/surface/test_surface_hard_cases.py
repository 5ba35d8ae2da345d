"""Surfaces from depth that is empty, noisy, contradictory or no number: bounded errors, never NaN."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.surface import SurfaceError
from edge_server.surface.depth import DepthMap, depth_map, render_depth_maps
from edge_server.surface.mesh import extract_mesh
from edge_server.surface.reconstruct import mesh_from_depth_maps
from edge_server.surface.refine_depth import REACH, refine_depth
from edge_server.surface.settings import MeshSettings
from edge_server.surface.volume import Grid, bounding_box, fuse_maps
from tests.edge_server.surface.ball import LENS, RADIUS_M, BallRenderer, ball_maps, poses_around

skimage = pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")

GRID = Grid((-0.13,) * 3, (0.13,) * 3, 0.005, 0.02)
pytestmark = pytest.mark.stability
RNG = np.random.default_rng(11)
GRAY = np.full((64, 64, 3), 90, np.uint8)


def with_depth(found: DepthMap, depth: np.ndarray) -> DepthMap:
    return depth_map(depth.astype(np.float32), found.color, found.camera_to_world, found.intrinsics)


def radii(maps) -> np.ndarray:
    mesh = mesh_from_depth_maps(maps, MeshSettings(voxel_m=0.005, bounds=(GRID.lower, GRID.upper)))
    assert np.isfinite(mesh.vertices).all()
    return np.linalg.norm(mesh.vertices, axis=1)


@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 1e30, 1e-30])
def test_depth_that_is_nothing_gives_no_surface_and_says_so(value):
    maps = [with_depth(m, np.full((64, 64), value)) for m in ball_maps(3)]
    volume = fuse_maps(GRID, maps)
    for array in (volume.blocks.distance, volume.blocks.weight, volume.blocks.color):
        assert np.isfinite(array).all()
    with pytest.raises(SurfaceError, match="no surface"):
        extract_mesh(volume)
    if not any(m.seen.any() for m in maps):
        with pytest.raises(SurfaceError, match="no camera sees anything solid"):
            bounding_box(maps, 0.01)


def test_noise_averages_out():
    quiet = ball_maps(30)
    noisy = [with_depth(m, m.depth + RNG.normal(0, 0.002, m.depth.shape)) for m in quiet]
    found = radii(noisy)
    # 2 mm of noise a pixel; a voxel hears of some dozens of them.
    assert abs(np.median(found) - RADIUS_M) < 0.001
    assert np.percentile(np.abs(found - RADIUS_M), 90) < 0.003


def test_one_camera_that_contradicts_all_others_is_outvoted():
    maps = ball_maps(30)
    liar = with_depth(maps[7], np.where(maps[7].seen, maps[7].depth - 0.06, maps[7].depth))
    found = radii([*maps[:7], liar, *maps[8:]])
    assert np.percentile(np.abs(found - RADIUS_M), 99) < 0.004


def test_cameras_that_agree_on_nothing_stay_within_bounds():
    maps = [with_depth(m, RNG.uniform(0.2, 0.6, m.depth.shape)) for m in ball_maps(12)]
    volume = fuse_maps(GRID, maps)
    assert np.abs(volume.blocks.distance).max() <= GRID.band_m + 1e-6  # (3.8)
    assert np.isfinite(volume.blocks.color).all()


def test_single_pixels_of_nonsense_do_not_spread():
    maps = []
    for m in ball_maps(20):
        depth = m.depth.copy()
        depth[RNG.random(depth.shape) < 0.05] = RNG.choice([np.nan, -3.0, 0.0, 1e20])
        maps.append(with_depth(m, depth))
    assert np.percentile(np.abs(radii(maps) - RADIUS_M), 95) < 0.003


def test_a_renderer_that_has_diverged():
    class Diverged(BallRenderer):
        def render(self, camera_to_world, intrinsics):
            good = super().render(camera_to_world, intrinsics)
            return replace(good, depth=good.depth * np.nan, opacity=good.opacity * np.nan)

    maps = list(render_depth_maps(Diverged(), [(pose, LENS) for pose in poses_around(3)]))
    assert not any(m.seen.any() or m.trust.any() for m in maps)


PICTURES = {
    "plain": lambda k: GRAY,
    "noise": lambda k: RNG.integers(0, 255, (64, 64, 3), dtype=np.uint8),
    "contradictory": lambda k: np.full((64, 64, 3), 255 * (k % 2), np.uint8),
}


@pytest.mark.parametrize("kind", PICTURES)
def test_depth_refined_by_pictures_of_nothing(kind):
    """Bounded depth, and never NaN: nothing lies farther from where it was than is searched."""
    maps = ball_maps(6)
    found = refine_depth(maps, [PICTURES[kind](k) for k in range(6)])
    for before, after in zip(maps, found):
        assert np.isfinite(after.trust).all() and np.isfinite(after.cosine).all()
        assert not np.isnan(after.depth).any()
        both = before.seen & after.seen
        assert (np.abs(after.depth / np.where(both, before.depth, 1) - 1)[both] <= REACH + 1e-5).all()
        np.testing.assert_array_equal(np.isposinf(after.depth), np.isposinf(before.depth))
    volume = fuse_maps(GRID, found)
    assert np.isfinite(volume.blocks.distance).all() and np.isfinite(volume.blocks.color).all()
    assert np.abs(volume.blocks.distance).max(initial=0.0) <= GRID.band_m + 1e-6
