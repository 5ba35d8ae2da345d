"""Marching cubes over blocks: the right surface, without dirt."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.surface import SurfaceError
from edge_server.surface import mesh as mesh_module
from edge_server.surface.mesh import extract_mesh, remove_degenerate, remove_small_components
from edge_server.surface.volume import Grid, fuse_maps
from tests.edge_server.surface.ball import RADIUS_M, ball_maps

pytest.importorskip("skimage", reason="scikit-image is not installed (extra surface)")
trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra surface)")

GRID = Grid((-0.13,) * 3, (0.13,) * 3, 0.005, 0.02)


@pytest.fixture(scope="module")
def ball():
    return fuse_maps(GRID, ball_maps(24))


def test_a_ball_comes_out_as_a_ball(ball):
    mesh = remove_small_components(extract_mesh(ball))
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert abs(radius.mean() - RADIUS_M) < 3e-4 and np.abs(radius - RADIUS_M).max() < 0.003
    # Faces look outwards, so the volume is positive.
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS_M**3, rel=0.02)
    top, bottom = (
        mesh.visual.vertex_colors[side, :3] for side in (mesh.vertices[:, 2] > 0.01, mesh.vertices[:, 2] < -0.01)
    )
    assert np.abs(top.astype(int) - (200, 20, 20)).mean() < 6 and np.abs(bottom.astype(int) - 90).mean() < 6


def test_a_mesh_beyond_memory_says_what_would_do(ball, monkeypatch):
    assert mesh_module.MOST_VOXELS == 1 << 27
    monkeypatch.setattr(mesh_module, "MOST_VOXELS", 50_000)
    with pytest.raises(SurfaceError, match=r"5 mm has too many voxels: take [\d.]+ mm or more"):
        extract_mesh(ball)


def test_what_nobody_saw_stays_open():
    seen_from_above = fuse_maps(GRID, [m for m in ball_maps(40) if m.camera_to_world[2, 3] > 0.1])
    assert extract_mesh(seen_from_above).vertices[:, 2].min() > -0.09  # the ball's lower end is missing


def test_dirt_goes_and_pieces_stay(ball):
    mesh = remove_small_components(extract_mesh(ball))
    dirt = mesh + trimesh.Trimesh([[0.2, 0, 0], [0.21, 0, 0], [0.2, 0.01, 0]], [[0, 1, 2]])
    assert len(remove_small_components(dirt).faces) == len(mesh.faces)
    assert len(remove_small_components(dirt, keep_share=0.0).faces) == len(mesh.faces) + 1


def test_faces_without_area_go():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 1], [0, 1, 3]], np.int32)
    found = remove_degenerate(trimesh.Trimesh(vertices, faces, process=False))
    assert found.faces.tolist() == [[0, 1, 2]] and len(found.vertices) == 3


def test_no_surface_is_an_error(ball):
    with pytest.raises(SurfaceError, match="no surface"):
        extract_mesh(ball, min_weight=1e9)
