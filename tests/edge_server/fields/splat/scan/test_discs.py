"""Discs from an image with depth: they lie on the surface, cover it, and are small where there is detail."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.splat.kernels.project import BASE, COLOR, QUATERNION, SCALE
from edge_server.fields.splat.scan import settings as tuned
from edge_server.fields.splat.scan.discs import discs, filled, quadtree, usable_depth
from freshfield.geometry import Pinhole, look_at, quaternion_to_matrix

LENS = Pinhole(50, 38, 40.0, 40.0, 25.0, 19.0, (-0.05, 0.01, 0.0, 0.0))


def _tilted(slope: float) -> np.ndarray:
    """Depth of the plane z = 2 + slope x, camera axes."""
    rays = LENS.rays()
    return (2.0 / (1.0 - slope * rays[..., 0] / rays[..., 2])).astype(np.float32)


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
    depth, pose = _tilted(slope), look_at((0.3, -2.0, 0.5), (0.0, 0.0, 0.2))
    color = np.broadcast_to(np.array([0.2, 0.5, 0.7], np.float32), (*depth.shape, 3)).copy()
    leaves = quadtree(color, np.ones(depth.shape, bool), (4,), 1.0)
    params = discs(color, depth, leaves, LENS, pose, 0.6, np.full(len(leaves.row), 0.8, np.float32))
    assert params.shape == (len(leaves.row), BASE) and np.isfinite(params).all()
    inside = (leaves.row > 4) & (leaves.row < 30) & (leaves.column > 4) & (leaves.column < 42)
    local = (params[inside, :3] - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(local[:, 2], 2.0 + slope * local[:, 0], rtol=0.05)
    np.testing.assert_allclose(LENS.project(local)[:, 0], leaves.column[inside] + 2.0, atol=0.01)
    axes = quaternion_to_matrix(params[inside, QUATERNION : QUATERNION + 4])
    normal = np.array([-slope, 0.0, 1.0]) / np.hypot(slope, 1.0) @ pose[:3, :3].T
    assert np.abs(axes[:, :, 2] @ normal).min() > 0.98
    sizes = np.exp(params[inside, SCALE : SCALE + 3])
    np.testing.assert_allclose(sizes[:, 0], 0.6 * 4 * local[:, 2] / LENS.fx, rtol=1e-4)
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
