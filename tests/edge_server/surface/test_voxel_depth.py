"""Voxels fitted for a mesh: nearer to the surface than a haze is, only where they are called for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.experiments.scenes.tile_scan import exact_depth, scan
from edge_server.fields import View
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.surface import reconstruct
from edge_server.surface.depth import depth_map
from edge_server.surface.metrics import depth_error_mm
from edge_server.surface.reconstruct import MeshSettings, make_depth_maps
from edge_server.surface.voxel_depth import (
    MIN_VIEWS,
    RELIABLE_TRUST,
    VOXEL_TRUST,
    fill_depth,
    fit_voxels,
    voxel_box,
)
from tests.edge_server.surface.shapes import LENS, BallRenderer, ball_maps, poses_around

BOX = SceneBox((0.0, 0.0, 0.03), 0.27, 0.09, False, 0.3, 0.006)


class Haze(BallRenderer):
    """Has a box, and a surface that is nowhere near the scene's."""

    def __init__(self, box: SceneBox) -> None:
        super().__init__()
        self.box, self.background = box, np.array([0.80, 0.83, 0.86], np.float32)


@pytest.fixture(scope="module")
def close():
    return scan(64, tuple((x, y, 0.03) for x in (-0.12, 0.0, 0.12) for y in (-0.06, 0.06)))


def test_depth_comes_from_the_pictures_whatever_the_field_shows(close):
    exact = [exact_depth(close.scene, v) for v in close.views]

    def median_mm(settings: MeshSettings) -> tuple[float, float]:
        maps = make_depth_maps(Haze(BOX), close.views, settings)
        rows = [depth_error_mm(np.where(m.seen, m.depth, 0), e) for m, e in zip(maps, exact)]
        covered = [m.seen[np.isfinite(e)].mean() for m, e in zip(maps, exact)]
        return float(np.nanmean([r["median_mm"] for r in rows])), float(np.mean(covered))

    found, covered = median_mm(MeshSettings(carve_steps=150))
    _, without = median_mm(MeshSettings(carve=False))
    assert found < 6.0  # a pixel spans 4.4 mm
    assert covered > 0.7 > 0.2 > without


def test_the_number_of_threads_changes_no_bit(close):
    one, three = (fit_voxels(BOX, None, close.views, 20, Pool(n, nice=0)) for n in (1, 3))
    view = close.views[0]
    a, b = (r.render(view.camera_to_world, view.intrinsics) for r in (one, three))
    np.testing.assert_array_equal(a.depth, b.depth)
    assert a.opacity.max() > 0.5


def test_what_pictures_know_stays_and_the_rest_is_filled():
    (start,) = ball_maps(1)
    rows = np.arange(64)[:, None] * np.ones((1, 64), np.int64)
    nearer = np.where(start.seen, start.depth - 0.01, start.depth)
    depth, trust = (np.where(rows < 32, x, 0).astype(np.float32) for x in (nearer, start.trust))
    sharp = replace(start, depth=depth, trust=trust)
    (found,) = fill_depth([sharp], [start])
    known = start.seen & (rows < 32)
    np.testing.assert_array_equal(found.depth[known], sharp.depth[known])
    rest = start.seen & (rows >= 32)
    assert known.any() and rest.any()
    np.testing.assert_array_equal(found.depth[rest], start.depth[rest])
    np.testing.assert_allclose(found.trust[rest], VOXEL_TRUST * start.cosine[rest])
    faint = replace(
        start, depth=start.depth + 0.02, trust=(0.9 * RELIABLE_TRUST * start.cosine).astype(np.float32)
    )
    np.testing.assert_array_equal(fill_depth([faint], [start])[0].depth[start.seen], start.depth[start.seen])


def test_nothing_is_carved_that_was_not_asked_for(monkeypatch):
    def never(*_):
        raise AssertionError("carved")

    monkeypatch.setattr(reconstruct, "fit_voxels", never)
    views = [View(f"c{k}", m.color, m.camera_to_world, LENS) for k, m in enumerate(ball_maps(4))]
    many = [views[0]] * MIN_VIEWS
    endless = Haze(replace(BOX, contracted=True))
    assert voxel_box(endless, many) is None and voxel_box(BallRenderer(), many) is None
    assert voxel_box(Haze(BOX), many[1:]) is None and voxel_box(Haze(BOX), many) == BOX
    for renderer, settings in (
        (BallRenderer(), MeshSettings()),
        (endless, MeshSettings()),
        (Haze(BOX), MeshSettings(carve=False)),
        (Haze(BOX), MeshSettings(sharpen=False)),
    ):
        assert len(make_depth_maps(renderer, many, settings)) == MIN_VIEWS
    assert len(make_depth_maps(Haze(BOX), views, MeshSettings())) == 4
    with pytest.raises(AssertionError, match="carved"):
        make_depth_maps(Haze(BOX), many, MeshSettings())


def test_maps_must_belong_together():
    maps = ball_maps(2)
    with pytest.raises(ValueError):
        fill_depth(maps, maps[:1])
    pose = poses_around(1)[0]
    nothing = depth_map(np.zeros((64, 64), np.float32), maps[0].color, pose, LENS)
    (found,) = fill_depth([nothing], [nothing])
    assert not found.seen.any() and not found.trust.any()
