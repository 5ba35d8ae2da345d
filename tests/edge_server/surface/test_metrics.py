"""The yardstick: what a mesh a known distance off measures, and that the truth is what cameras see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from camera_node.synthetic import make_scene
from edge_server.experiments.scenes.mesh_truth import surface_truth
from edge_server.surface import SurfaceError
from edge_server.surface.depth import depth_map
from edge_server.surface.mesh import Mesh
from edge_server.surface.metrics import Truth, compare, sample_mesh, thin_points
from tests.edge_server.surface.tile_scan import exact_depth, scan


def sheet(z: float, share: float = 1.0) -> Mesh:
    """A square of 0.1 m, or its left share, at a height."""
    x = 0.1 * share
    corners = np.array([[0, 0, z], [x, 0, z], [x, 0.1, z], [0, 0.1, z]], np.float32)
    return Mesh(corners, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.zeros((4, 3), np.uint8))


def truth(cameras: int = 2) -> Truth:
    x, y = np.meshgrid(np.arange(0, 0.1, 0.0005), np.arange(0, 0.1, 0.0005))
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=-1)
    return Truth(points, np.full(len(points), cameras))


@pytest.mark.parametrize("off_mm", [1.0, 2.5, 4.0])
def test_a_sheet_that_is_off_measures_how_much(off_mm):
    found = compare(sheet(1e-3 * off_mm), truth())
    assert found.chamfer_mm == pytest.approx(off_mm, rel=0.05)
    assert found.accuracy_median_mm == pytest.approx(off_mm, rel=0.05)
    assert found.complete == found.precise == (1.0 if off_mm < 3 else 0.0)


def test_half_a_sheet_is_accurate_and_half_complete():
    found = compare(sheet(0.0, 0.5), truth())
    assert found.accuracy_mm < 0.3 and found.precise == 1.0
    assert found.complete == pytest.approx(0.53, abs=0.01)  # the half, and 3 mm more


def test_only_what_two_cameras_see_is_asked_for():
    none = Mesh(*(np.zeros((0, 3), kind) for kind in (np.float32, np.int32, np.uint8)))
    for mesh, seen in ((sheet(0.0), truth(cameras=1)), (none, truth())):
        with pytest.raises(SurfaceError, match="nothing to compare"):
            compare(mesh, seen)


def test_points_are_spread_evenly_and_repeatably():
    points = sample_mesh(sheet(0.0), 10_000)
    assert np.array_equal(points, sample_mesh(sheet(0.0), 10_000))
    counts, _, _ = np.histogram2d(points[:, 0], points[:, 1], bins=5, range=[[0, 0.1], [0, 0.1]])
    assert counts.min() > 320 and counts.max() < 480


def test_thinning_leaves_one_a_cell():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (5000, 3))
    kept = points[thin_points(points, 0.25)]
    cells, of_kept = (len(np.unique(np.floor(some / 0.25), axis=0)) for some in (points, kept))
    assert of_kept == len(kept) == cells


def test_the_truth_of_an_object_leaves_out_what_stands_around_it():
    close = scan(24, raster=((-0.2, 0.1, 0.03),))
    bench = make_scene("tile", {"count": 1, "width": 24, "height": 24, "bench": True})
    found = surface_truth(replace(bench, cameras=close.scene.cameras), close.views, spacing_m=0.004)
    low, high = close.scene.bounds
    assert len(found.points) > 100 and ((found.points >= low) & (found.points <= high)).all()


def test_the_truth_is_on_what_the_cameras_see():
    close = scan(24, raster=((-0.1, 0.0, 0.03), (0.1, 0.0, 0.03)))
    found = surface_truth(close.scene, close.views, spacing_m=0.004)
    assert len(close.views) == 10 and 0.2 < (found.cameras >= 2).mean() <= 1.0
    low, high = close.scene.bounds
    assert ((found.points >= low) & (found.points <= high)).all()
    # What a camera's own rays meet is part of it.
    view = close.views[3]
    depth, pose = exact_depth(close.scene, view), view.camera_to_world
    shown = depth_map(depth.astype(np.float32), view.image, pose, view.intrinsics, steepest_deg=70.0)
    points = shown.points()
    away, _ = cKDTree(found.points).query(points)
    assert len(points) > 100 and np.percentile(away, 98) < 0.004
