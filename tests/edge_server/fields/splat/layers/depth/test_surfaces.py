"""Depth plates drawn from other places; large planes, virtual plates, and what cameras share."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.scene_box import UNIT_BOX
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.splat.kernels.project import COLOR, QUATERNION, SCALE
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.depth_plate import smooth
from edge_server.fields.splat.layers.depth.first_gaussians import first_gaussians
from edge_server.fields.splat.layers.depth.large_planes import Plane, continued, large_planes
from edge_server.fields.splat.layers.depth.overlaps import contradicting, exposures
from edge_server.fields.splat.layers.depth.surfaces import Surface, SurfaceScene
from edge_server.fields.splat.layers.depth.virtual_plates import beside_silhouettes, poses_between, virtual_plates
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole, look_at, quaternion_to_matrix
from tests.edge_server.fields.scenes import ring, seen
from tests.edge_server.fields.splat.layers.depth.room_plates import room_surfaces

POOL = CallerPool()


def surface_of(view: View, scale: float = 1.0, gain: float = 1.0) -> Surface:
    """What a camera with a perfect sensor knows of the scene of balls; the sky has no depth."""
    image, distance = seen(view.intrinsics, view.camera_to_world)
    z = distance * view.intrinsics.rays()[..., 2] * scale
    inverse = np.where(np.isfinite(z), 1.0 / z, 0.0).astype(np.float32)
    color = (image * gain).astype(np.float32)
    known = np.ones(z.shape, bool)
    return Surface(view.intrinsics, view.camera_to_world, color, known, *smooth(inverse, color, POOL))


CAMERAS = ring(7)
SURFACES = [surface_of(view) for view in CAMERAS[:6]]
SCENE = SurfaceScene.of(SURFACES)


def test_normals_and_points_are_those_of_a_plane() -> None:
    """A wall that passes 2 m ahead, turned by the camera's pose."""
    lens, pose = Pinhole.from_fov(20, 16, 70.0), look_at((1.0, 2.0, 3.0), (0.0, 0.0, 0.0))
    normal = np.array([0.3, -0.2, -0.9]) / np.linalg.norm([0.3, -0.2, -0.9])  # camera axes, towards the camera
    v, u = np.mgrid[:16, :20]
    rays = np.stack([(u + 0.5 - lens.cx) / lens.fx, (v + 0.5 - lens.cy) / lens.fy, np.ones((16, 20))], axis=-1)
    inverse = rays @ (-normal / 1.8)
    slope = np.broadcast_to(-normal[:2] / 1.8 / [lens.fx, lens.fy], (16, 20, 2)).astype(np.float32)
    black = np.zeros((16, 20, 3), np.float32)
    surface = Surface(lens, pose, black, np.ones((16, 20), bool), inverse.astype(np.float32), slope)
    np.testing.assert_allclose(surface.normals(), np.broadcast_to(pose[:3, :3] @ normal, (16, 20, 3)), atol=1e-5)
    local = (surface.points() - pose[:3, 3]) @ pose[:3, :3]
    np.testing.assert_allclose(local @ normal, -1.8, rtol=1e-5)
    assert surface.joined()[:-1, :-1].all() and not surface.joined()[-1].any()


def _wall(lens: Pinhole, pose: NDArray, z_m: float, level: float) -> Surface:
    """A wall that fills a camera's image at one depth."""
    shape = lens.height, lens.width
    inverse, color = np.full(shape, 1.0 / z_m, np.float32), np.full((*shape, 3), level, np.float32)
    return Surface(lens, pose, color, np.ones(shape, bool), inverse, np.zeros((*shape, 2), np.float32))


def test_what_more_cameras_see_through_is_not_drawn() -> None:
    """Three cameras side by side look at a wall; one of them says that it is nearer."""
    lens = Pinhole.from_fov(32, 32, 60.0)
    poses = [np.eye(4) for _ in range(3)]
    for k, pose in enumerate(poses):
        pose[0, 3] = 0.05 * k
    walls = [_wall(lens, poses[0], 1.0, 50.0), _wall(lens, poses[1], 2.0, 200.0), _wall(lens, poses[2], 2.0, 200.0)]
    (color,), (agreement,), _ = SurfaceScene.of(walls).render([poses[1]], lens, POOL)
    inside = np.s_[4:28, 4:28]
    np.testing.assert_allclose(color[inside], 200.0 / 255.0, atol=1e-3)
    assert (agreement[inside] == 1.0).all()


def test_virtual_plates_are_spread_between_the_cameras() -> None:
    poses = [view.camera_to_world for view in CAMERAS[:2]]
    between = poses_between(poses, SURFACES[:2], 12)
    target = np.array([0.0, 0.0, 0.4])
    angles = []
    for pose in between:
        away = pose[:3, 3] - target
        np.testing.assert_allclose(pose[:3, 2], -away / np.linalg.norm(away), atol=0.05)
        angles.append(np.degrees(np.arctan2(away[1], away[0])))
    assert min(angles) > -21.0 and max(angles) < 73.0 and np.ptp(angles) > 60.0
    plates = virtual_plates(SCENE, SURFACES, poses, True, POOL)
    assert len(plates) == tuned.VIRTUAL_PLATES and all(" " in plate.view.camera for plate in plates)
    assert all(plate.known.min() == np.float32(tuned.UNSEEN_WEIGHT) for plate in plates)
    assert any((plate.known == 0).any() for plate in virtual_plates(SCENE, SURFACES, poses, False, POOL))


@pytest.mark.parametrize(("width", "near"), [(48, None), (128, 2), (640, 3)])
def test_pixels_beside_a_silhouette_are_found(width: int, near: int | None) -> None:
    q = np.tile(np.linspace(0.2, 0.5, 40, dtype=np.float32)[:, None], (1, width))  # a floor
    assert not beside_silhouettes(q).any()
    q[10:20, 8:18] += np.float32(2.0 * tuned.CUT)  # a box on it: the jump lies between two pixels
    left, right = (range(k - 1 - near, k + 1 + near) if near is not None else () for k in (8, 18))
    assert np.flatnonzero(beside_silhouettes(q)[15]).tolist() == [*left, *right]


def test_first_gaussians_lie_on_the_surfaces() -> None:
    found = first_gaussians(SURFACES, UNIT_BOX, SplatSettings(start=600), np.random.default_rng(0))
    assert found.shape[0] == 600 and np.isfinite(found).all()
    ball = np.linalg.norm(found[:, :3] - [0.0, 0.0, 0.5], axis=1)
    on_ball, on_ground = np.abs(ball - 0.5) < 0.03, np.abs(found[:, 2]) < 0.03
    assert (on_ball | on_ground).mean() > 0.9
    normal = quaternion_to_matrix(found[:, QUATERNION : QUATERNION + 4])[:, :, 2]
    outwards = (found[:, :3] - [0.0, 0.0, 0.5]) / ball[:, None]
    assert np.median(np.abs((normal * outwards).sum(axis=1))[on_ball & ~on_ground]) > 0.95
    assert (found[:, SCALE + 2] < found[:, SCALE]).all() and ((found[:, COLOR:] >= 0) & (found[:, COLOR:] <= 1)).all()


def test_depth_of_a_wrong_scale_contradicts_the_others() -> None:
    assert contradicting(SURFACES) == []
    spoiled = [surface_of(view, scale) for view, scale in zip(CAMERAS, (1.0, 1.0, 10.0, 1.0))]
    assert contradicting(spoiled) == [2]
    assert contradicting([surface_of(view, scale) for view, scale in zip(CAMERAS, (1.0, 0.1))]) == [1]
    assert contradicting([surface_of(view, 1000.0) for view in CAMERAS[:4]]) == [0, 1, 2, 3]
    assert contradicting([surface_of(CAMERAS[0], 10.0)]) == []  # alone, nothing tells


def test_cameras_that_share_nothing_do_not_contradict_each_other_whatever_their_lens() -> None:
    """Barrel distortion, continued, leads what is far aside back into the image."""
    lens = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0, (-0.3, 0.0, 0.0, 0.0))
    poses = [look_at((0.0, 0.0, 0.0), (np.cos(a), np.sin(a), 0.0)) for a in np.arange(6) * np.pi / 3.0]
    assert contradicting([_wall(lens, pose, 2.0, 100.0) for pose in poses]) == []


def test_exposures_follow_from_what_cameras_share() -> None:
    gains = np.array([0.8, 1.0, 1.1, 0.9])
    found = exposures([surface_of(view, gain=gain) for view, gain in zip(CAMERAS, gains)])
    logs = np.log(gains) - np.log(gains).mean()
    np.testing.assert_allclose(found, np.broadcast_to(logs[:, None], (4, 3)), atol=0.03)
    blind = replace(surface_of(CAMERAS[1]), inverse=np.zeros_like(SURFACES[1].inverse))
    np.testing.assert_allclose(exposures([surface_of(CAMERAS[0], gain=0.8), blind])[:, 0], [-0.112, 0.112], atol=0.03)


def _planes(surfaces: Sequence[Surface]) -> list[Plane]:
    return large_planes(surfaces, np.random.default_rng(0))


def _opened(surface: Surface) -> Surface:
    inverse = surface.inverse.copy()
    inverse[:24] = 0.0
    return replace(surface, inverse=inverse)


def test_what_has_no_depth_gets_that_of_the_nearest_plane_and_the_rest_stays() -> None:
    surfaces = room_surfaces(4, 64)
    planes = _planes(surfaces)
    right = []
    for surface in surfaces:
        found = continued(_opened(surface), planes)
        np.testing.assert_array_equal(found.inverse[24:], surface.inverse[24:])
        unknown = replace(_opened(surface), known=np.zeros_like(surface.known))
        assert not continued(unknown, planes).inverse[:24].any()
        right.append(np.abs(found.inverse[:24] / surface.inverse[:24] - 1.0) < 0.05)
    assert np.mean(right) > 0.6


@pytest.mark.stability
def test_no_depth_one_point_and_one_wall() -> None:
    surface = room_surfaces(4, 64)[0]
    nothing = replace(surface, inverse=np.zeros_like(surface.inverse))
    assert _planes([nothing]) == [] and (continued(nothing, []).inverse == 0).all()
    point = nothing.inverse.copy()
    point[5, 5] = 0.5
    assert np.isfinite(continued(nothing, _planes([replace(nothing, inverse=point)])).inverse).all()
    wall = replace(surface, inverse=np.full_like(surface.inverse, 0.5), slope=np.zeros_like(surface.slope))
    (plane,) = _planes([wall])
    np.testing.assert_allclose(np.abs(plane.normal @ surface.pose[:3, 2]), 1.0, atol=1e-6)
