"""Registration of poses and depth scales, on the exact depth of the synthetic room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from edge_server.fields import View
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.layers.depth import settings
from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate
from edge_server.fields.splat.layers.depth.depth_supervision import CameraPlates, DepthSupervision
from edge_server.fields.splat.layers.depth.registration import Correction, register, register_stereo
from edge_server.fields.splat.layers.depth.surfaces import Surface
from edge_server.fields.splat.layers.static_layer import PlateImage
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole, se3, so3_exp
from tests.edge_server.fields.splat.layers.depth.room_plates import room_plates, room_surfaces
from tests.edge_server.fields.splat.layers.depth.test_plate_stereo import filled

SIZE = 96
TURN_DEG = (2.0, -1.5, 1.0)


def _bumped(surface: Surface) -> Surface:
    pose = surface.pose
    return replace(surface, pose=se3(so3_exp(np.deg2rad(TURN_DEG)) @ pose[:3, :3], pose[:3, 3]))


def _off(found: Correction, true_pose: np.ndarray) -> tuple[float, float]:
    """Degrees and meters from the true pose."""
    turn = np.arccos(np.clip((np.trace(found.pose[:3, :3] @ true_pose[:3, :3].T) - 1.0) / 2.0, -1.0, 1.0))
    return float(np.rad2deg(turn)), float(np.linalg.norm(found.pose[:3, 3] - true_pose[:3, 3]))


def test_right_poses_and_scales_stay() -> None:
    surfaces = room_surfaces(4, SIZE)
    for found, surface in zip(register(surfaces), surfaces):
        turn_deg, shift_m = _off(found, surface.pose)
        assert turn_deg < 0.06 and shift_m < 0.004 and abs(found.scale - 1.0) < 0.003
        assert not found.is_large


def test_a_camera_that_was_bumped_is_found() -> None:
    surfaces = room_surfaces(4, SIZE)
    found = register([*surfaces[:2], _bumped(surfaces[2]), surfaces[3]])
    assert [c.is_large for c in found] == [False, False, True, False]
    turn_deg, shift_m = _off(found[2], surfaces[2].pose)
    assert turn_deg < 0.2 and shift_m < 0.004
    # What it says of the correction is measured from the pose that was reported.
    assert found[2].turn_deg == pytest.approx(float(np.linalg.norm(TURN_DEG)), abs=0.2) and found[2].shift_m < 0.004
    assert f"stands {found[2].turn_deg:.1f} degrees" in str(found[2])


def test_depth_of_another_scale_is_found() -> None:
    first, *others = room_surfaces(4, SIZE)
    by = np.float32(1.0 / 1.05)
    wrong = replace(first, inverse=first.inverse * by, slope=first.slope * by)
    found = register([wrong, *others])
    assert found[0].scale == pytest.approx(1.0 / 1.05, rel=0.006) and found[0].is_large
    assert not any(c.is_large for c in found[1:])
    corrected = found[0].applied(wrong)
    known = first.inverse > 0
    np.testing.assert_allclose(corrected.inverse[known], first.inverse[known], rtol=0.006)


@pytest.mark.stability
def test_cameras_that_share_nothing_stay_as_they_were_reported() -> None:
    surfaces = room_surfaces(2, SIZE)
    away = replace(surfaces[1], pose=se3(surfaces[1].pose[:3, :3], surfaces[1].pose[:3, 3] + [50.0, 0.0, 0.0]))
    blank = replace(surfaces[0], inverse=np.zeros_like(surfaces[0].inverse))
    for pair in ([surfaces[0], away], [blank, surfaces[1]]):
        for found, surface in zip(register(pair), pair):
            np.testing.assert_allclose(found.pose, surface.pose, atol=1e-9)
            assert found.scale == 1.0


def _plates(k: int, surface: Surface) -> CameraPlates:
    view = View(f"cam{k:02d}", surface.color.astype(np.uint8), surface.pose, surface.lens)
    plate, depth = PlateImage(view, surface.color, surface.known), DepthPlate.empty(SIZE, SIZE)
    meters = np.where(surface.inverse > 0, 1.0 / np.maximum(surface.inverse, 1e-6), 0.0).astype(np.float32)
    for _ in range(settings.LEAST):
        depth.take(meters, np.zeros((SIZE, SIZE), bool), shared_pool())
    return CameraPlates(plate, plate, depth, surface.pose)


def test_a_camera_that_joins_is_registered_with_the_others() -> None:
    surfaces = room_surfaces(3, SIZE)
    cameras = [_plates(k, s) for k, s in enumerate([*surfaces[:2], _bumped(surfaces[2])])]
    depth = DepthSupervision(SplatSettings(), shared_pool())
    depth.plates(cameras[:2], anew=True)
    assert set(depth.corrections) == {"cam00", "cam01"} and not depth.troubles
    before = depth.corrections
    depth.plates(cameras[:2], anew=False)
    assert depth.corrections is before
    depth.plates(cameras, anew=False)
    assert set(depth.displaced) == {"cam02"} and "cam02 stands" in depth.troubles[0]
    turn_deg, _ = _off(depth.corrections["cam02"], surfaces[2].pose)
    assert turn_deg < 0.4


def _off_lines_px(poses: Sequence[np.ndarray], true: Sequence[np.ndarray], lens: Pinhole) -> float:
    """How far points of the scene appear from their epipolar lines, median over all pairs of cameras."""
    points, off = np.random.default_rng(9).uniform((-2.0, -1.0, 0.0), (2.0, 2.0, 2.0), (200, 3)), []
    rays = [(points - its[:3, 3]) @ its[:3, :3] @ pose[:3, :3].T for pose, its in zip(poses, true)]
    for i, j in combinations(range(len(poses)), 2):
        normal = np.cross(poses[j][:3, 3] - poses[i][:3, 3], rays[i])
        sine = (normal * rays[j]).sum(axis=1) / (np.linalg.norm(normal, axis=1) * np.linalg.norm(rays[j], axis=1))
        off.append(lens.fx * np.abs(sine))
    return float(np.median(off))


def test_brightness_corrects_poses_under_which_stereo_has_found_the_depth() -> None:
    plates, _ = room_plates(4)
    true, px = [p.pose for p in plates], []
    for seed in range(2):
        turns = np.deg2rad(0.12) * np.random.default_rng(seed).standard_normal((4, 3))
        told = [replace(p, pose=se3(p.pose[:3, :3] @ so3_exp(t), p.pose[:3, 3])) for p, t in zip(plates, turns)]
        surfaces = filled(told)
        reported = [of.pose for of in told]
        found = register_stereo(surfaces, reported, 3.0)
        assert all(c.scale == 1.0 and not c.is_large and "depth" not in str(c) for c in found)
        px.append(
            [_off_lines_px(poses, true, plates[0].lens) for poses in ([p.pose for p in told], [c.pose for c in found])]
        )
    # From there, the prior is still about the reported poses.
    there = [replace(s, pose=c.pose) for s, c in zip(surfaces, found)]
    for one, other in zip(found, register_stereo(there, reported, 3.0)):
        assert other.turn_deg == pytest.approx(one.turn_deg, abs=0.05)
    before, after = np.mean(px, axis=0)
    assert after < 0.6 * before


def test_exact_poses_stay_where_stereo_has_found_the_depth() -> None:
    plates, _ = room_plates(4)
    surfaces = filled(plates)
    for unit in (1.0, 1e-2):
        by, scaled = np.float32(1.0 / unit), []
        for s in surfaces:
            pose = se3(s.pose[:3, :3], unit * s.pose[:3, 3])
            scaled.append(replace(s, pose=pose, inverse=s.inverse * by, slope=s.slope * by))
        for found, surface in zip(register_stereo(scaled, [s.pose for s in scaled], 3.0 * unit), scaled):
            np.testing.assert_allclose(found.pose, surface.pose, atol=1e-12)
