"""Depth becomes a volume or a distance function, and that the right surface, without dirt; hard cases too."""

import numpy as np
import pytest
import torch

from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.surface import SurfaceError
from edge_server.surface import surface_constants as tuned
from edge_server.surface import volume as volume_module
from edge_server.surface.depth import DepthMap, depth_map
from edge_server.surface.kernels.fuse import SIDE
from edge_server.surface.kernels.lens import distort
from edge_server.surface.mesh import extract_mesh, remove_degenerate, remove_small_components
from edge_server.surface.reconstruct import mesh_from_depth_maps
from edge_server.surface.sdf import fit_sdf
from edge_server.surface.settings import MeshSettings
from edge_server.surface.volume import Grid, bounding_box, fuse_maps
from tests.edge_server.surface import ball as balls
from tests.support import refused

pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra surface)")

GRID = Grid((-0.13,) * 3, (0.13,) * 3, 0.005, 0.02)
COARSE = Grid((-0.13,) * 3, (0.13,) * 3, 0.008, 0.032)
RNG = np.random.default_rng(11)


@pytest.mark.parametrize("camera", [balls.LENS, balls.DISTORTED_LENS, balls.TILTED_LENS])
def test_the_kernel_fuses_as_the_equations_say_whatever_the_number_of_threads(camera):
    maps = balls.ball_maps(5, camera)
    volume, alike = (fuse_maps(COARSE, maps, pool=Pool(threads, nice=0)) for threads in (1, 3))
    for one, other in zip(volume.blocks, alike.blocks):
        np.testing.assert_array_equal(one, other)
    rng = np.random.default_rng(0)
    number, cell = rng.integers(0, len(volume.blocks.place), 400), rng.integers(0, SIDE**3, 400)
    distance, weight = balls.plain_fuse(COARSE, maps, balls.voxel_points(volume)[number, cell])
    assert (weight > 0).mean() > 0.3
    np.testing.assert_allclose(volume.blocks.weight[number, cell], weight, atol=2e-5)
    np.testing.assert_allclose(volume.blocks.distance[number, cell], distance, atol=1e-6)


@pytest.mark.parametrize(("k1", "k2"), [(-0.3, 0.0), (-0.5, 0.1), (-0.3, 0.1), (0.2, -0.05), (-0.1, -0.05), (0.1, 0.1)])
def test_no_two_places_before_a_lens_have_one_pixel(k1, k2):
    """Or what lies beside the image would be carved away by those who do not see it."""
    radii = np.linspace(0.0, 3.9, 300)
    shown = np.array([distort(0.6 * r, 0.8 * r, k1, k2, 0.0, 0.0) for r in radii])
    grows = np.logical_and.accumulate(1.0 + 3.0 * k1 * radii**2 + 5.0 * k2 * radii**4 > 0.0)
    np.testing.assert_array_equal(np.isfinite(shown[:, 0]), grows)
    assert (np.diff(shown[grows], axis=0) > 0.0).all()


def test_too_fine_a_grid_says_what_would_do(monkeypatch):
    maps = balls.ball_maps(4)
    blocks = np.ptp(fuse_maps(GRID, maps).blocks.place, axis=0) + 1
    monkeypatch.setattr(volume_module, "MOST_VOXELS", int(blocks.prod()) * SIDE**3)
    fuse_maps(GRID, maps)
    monkeypatch.setattr(volume_module, "MOST_VOXELS", int(blocks.prod()) * SIDE**3 // 8)
    refused(SurfaceError, "5 mm has too many voxels: take 10 mm or more", fuse_maps, GRID, maps)
    for grid, said in (
        (((-50.0,) * 3, (50.0,) * 3, 0.001, 0.004), "voxels are too many"),
        (((0, 0, 1), (1, 1, 1), 0.1, 0.4), "lower corner"),
    ):
        refused(SurfaceError, said, Grid, *grid)


def test_bounds_are_those_of_what_is_seen():
    low, high = bounding_box(balls.ball_maps(), 0.01)
    assert np.allclose(low, -0.11, atol=0.006) and np.allclose(high, 0.11, atol=0.006)


def test_distances_are_those_of_the_ball_with_a_slope_of_one(monkeypatch):
    for name, value in (("LEVELS", 2), ("POINTS", 4000), ("EIKONAL", 0.3)):
        monkeypatch.setattr(tuned, f"SDF_{name}", value)
    volume = fit_sdf(COARSE, balls.ball_maps(16))
    truth = np.linalg.norm(balls.voxel_points(volume), axis=-1) - balls.RADIUS_M
    assert np.abs(volume.blocks.distance - truth)[np.abs(truth) < 0.01].mean() < 0.0015
    radius = np.linalg.norm(remove_small_components(extract_mesh(volume)).vertices, axis=1)
    assert abs(radius.mean() - balls.RADIUS_M) < 0.0007
    distance = volume.blocks.distance.reshape(-1, SIDE, SIDE, SIDE)
    known = (np.abs(truth) < 0.02).reshape(distance.shape)[:, 1:-1, 1:-1, 1:-1]
    parts = [np.gradient(distance, COARSE.voxel_m, axis=k)[:, 1:-1, 1:-1, 1:-1] for k in (1, 2, 3)]
    steep = np.abs(np.sqrt(sum(p**2 for p in parts)) - 1.0)[known].mean()
    assert steep < 0.12, "without the eikonal term it is 0.20"


def test_the_number_of_threads_changes_no_bit_of_a_distance_function(monkeypatch):
    for name, value in (("LEVELS", 2), ("STEPS", 10), ("POINTS", 2000)):
        monkeypatch.setattr(tuned, f"SDF_{name}", value)
    maps, found = balls.ball_maps(4), []
    for threads in (1, 2, torch.get_num_threads()):  # as it was, at last
        torch.set_num_threads(threads)
        found.append(fit_sdf(COARSE, maps).blocks.distance)
    np.testing.assert_array_equal(found[0], found[1])


@pytest.fixture(scope="module")
def ball():
    return fuse_maps(GRID, balls.ball_maps(24))


def test_a_ball_comes_out_as_a_ball(ball):
    mesh = remove_small_components(extract_mesh(ball))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radius.mean() - balls.RADIUS_M) < 3e-4 and np.abs(radius - balls.RADIUS_M).max() < 0.003
    # Faces look outwards, so the volume is positive.
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * balls.RADIUS_M**3, rel=0.02)
    color, up = mesh.visual.vertex_colors[:, :3], mesh.vertices[:, 2]
    top, bottom = color[up > 0.01], color[up < -0.01]
    assert np.abs(top.astype(int) - (200, 20, 20)).mean() < 6 and np.abs(bottom.astype(int) - 90).mean() < 6


def test_dirt_and_faces_without_area_go_and_pieces_stay(ball):
    mesh = remove_small_components(extract_mesh(ball))
    dirt = mesh + trimesh.Trimesh([[0.2, 0, 0], [0.21, 0, 0], [0.2, 0.01, 0]], [[0, 1, 2]])
    assert len(remove_small_components(dirt).faces) == len(mesh.faces)
    assert len(remove_small_components(dirt, keep_share=0.0).faces) == len(mesh.faces) + 1
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 1], [0, 1, 3]], np.int32)
    found = remove_degenerate(trimesh.Trimesh(vertices, faces, process=False))
    assert found.faces.tolist() == [[0, 1, 2]] and len(found.vertices) == 3


def with_depth(found: DepthMap, depth: np.ndarray) -> DepthMap:
    return depth_map(depth.astype(np.float32), found.color, found.camera_to_world, found.intrinsics)


def radii(maps) -> np.ndarray:
    mesh = mesh_from_depth_maps(maps, MeshSettings(voxel_m=0.005, bounds=(GRID.lower, GRID.upper)))
    assert np.isfinite(mesh.vertices).all()
    return np.linalg.norm(mesh.vertices, axis=1)


@pytest.mark.stability
@pytest.mark.parametrize("value", [-1.0, np.nan, np.inf, 1e30, 1e-30])
def test_depth_that_is_nothing_gives_no_surface_and_says_so(value):
    maps = [with_depth(m, np.full((64, 64), value)) for m in balls.ball_maps(3)]
    volume = fuse_maps(GRID, maps)
    for array in (volume.blocks.distance, volume.blocks.weight, volume.blocks.color):
        assert np.isfinite(array).all()
    refused(SurfaceError, "no surface", extract_mesh, volume)
    if not any(m.seen.any() for m in maps):
        refused(SurfaceError, "no camera sees anything solid", bounding_box, maps, 0.01)


@pytest.mark.stability
def test_one_camera_that_contradicts_all_others_is_outvoted():
    maps = balls.ball_maps(30)
    liar = with_depth(maps[7], np.where(maps[7].seen, maps[7].depth - 0.06, maps[7].depth))
    assert np.percentile(np.abs(radii([*maps[:7], liar, *maps[8:]]) - balls.RADIUS_M), 99) < 0.004


@pytest.mark.stability
def test_noise_averages_out_and_single_pixels_of_nonsense_do_not_spread():
    maps = []
    for m in balls.ball_maps(30):
        depth = m.depth + RNG.normal(0, 0.002, m.depth.shape)
        depth[RNG.random(depth.shape) < 0.05] = RNG.choice([np.nan, -3.0, 0.0, 1e20])
        maps.append(with_depth(m, depth))
    found = radii(maps)
    # 2 mm of noise a pixel; a voxel hears of some dozens of them.
    assert abs(np.median(found) - balls.RADIUS_M) < 0.001
    assert np.percentile(np.abs(found - balls.RADIUS_M), 95) < 0.003


def test_what_nobody_saw_stays_open():
    seen_from_above = fuse_maps(GRID, [m for m in balls.ball_maps(40) if m.camera_to_world[2, 3] > 0.1])
    assert extract_mesh(seen_from_above).vertices[:, 2].min() > -0.09  # the ball's lower end is missing
