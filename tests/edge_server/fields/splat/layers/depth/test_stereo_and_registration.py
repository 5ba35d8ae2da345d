"""Registration of poses and depth scales, and stereo of plates, on the exact depth of the synthetic room."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate
from edge_server.fields.splat.layers.depth.depth_supervision import CameraPlates, DepthSupervision
from edge_server.fields.splat.layers.depth.plate_stereo import PlateStereo
from edge_server.fields.splat.layers.depth.registration import Correction, register, register_stereo
from edge_server.fields.splat.layers.depth.surfaces import Surface
from edge_server.fields.splat.layers.static_layer import PlateImage
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole, se3, so3_exp
from tests.edge_server.fields.splat.layers.depth.room_plates import plate_of, room_plates, room_surfaces

SIZE = 96
TURN_DEG = (2.0, -1.5, 1.0)


def _bumped(surface: Surface) -> Surface:
    pose = surface.pose
    return replace(surface, pose=se3(so3_exp(np.deg2rad(TURN_DEG)) @ pose[:3, :3], pose[:3, 3]))


def _off(found: Correction, true_pose: np.ndarray) -> tuple[float, float]:
    """Degrees and meters from the true pose."""
    turn = np.arccos(np.clip((np.trace(found.pose[:3, :3] @ true_pose[:3, :3].T) - 1.0) / 2.0, -1.0, 1.0))
    return float(np.rad2deg(turn)), float(np.linalg.norm(found.pose[:3, 3] - true_pose[:3, 3]))


def test_a_camera_that_was_bumped_is_found_and_the_others_stay() -> None:
    surfaces = room_surfaces(4, SIZE)
    for right, surface in zip(register(surfaces), surfaces):
        turn_deg, shift_m = _off(right, surface.pose)
        assert turn_deg < 0.06 and shift_m < 0.004 and abs(right.scale - 1.0) < 0.003 and not right.is_large
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
    np.testing.assert_allclose(found[0].applied(wrong).inverse, first.inverse, rtol=0.006)


@pytest.mark.stability
def test_cameras_that_share_nothing_stay_as_they_were_reported() -> None:
    surfaces = room_surfaces(2, SIZE)
    away = replace(surfaces[1], pose=se3(surfaces[1].pose[:3, :3], surfaces[1].pose[:3, 3] + [50.0, 0.0, 0.0]))
    blank = replace(surfaces[0], inverse=np.zeros_like(surfaces[0].inverse))
    folding, wall = replace(Pinhole.from_fov(SIZE, SIZE, 50.0), distortion=(-0.25, 0.0, 0.0, 0.0)), blank.inverse + 0.5
    apart = [replace(s, lens=folding, inverse=wall, slope=0 * s.slope) for s in surfaces]  # before one wall
    apart = [replace(s, pose=se3(np.eye(3), [4.2 * k, 0.0, 0.0])) for k, s in enumerate(apart)]
    for pair in ([surfaces[0], away], [blank, surfaces[1]], apart):
        for found, surface in zip(register(pair), pair):
            np.testing.assert_allclose(found.pose, surface.pose, atol=1e-9)
            assert found.scale == 1.0


def test_a_camera_that_joins_is_registered_with_the_others() -> None:
    surfaces, cameras = room_surfaces(3, SIZE), []
    for k, surface in enumerate([*surfaces[:2], _bumped(surfaces[2])]):
        view = View(f"cam{k:02d}", surface.color.astype(np.uint8), surface.pose, surface.lens)
        plate, measured = PlateImage(view, surface.color, surface.known), DepthPlate.empty(SIZE, SIZE)
        for _ in range(tuned.LEAST):
            measured.take(surface.depth(), np.zeros((SIZE, SIZE), bool))
        cameras.append(CameraPlates(plate, plate, measured, surface.pose))
    depth = DepthSupervision(SplatSettings(), shared_pool())
    depth.plates(cameras[:2], anew=True)
    assert set(depth.corrections) == {"cam00", "cam01"} and not depth.troubles
    before = depth.corrections
    depth.plates(cameras[:2], anew=False)
    assert depth.corrections is before
    depth.plates(cameras, anew=False)
    assert set(depth.displaced) == {"cam02"} and "cam02 stands" in depth.troubles[0]
    assert _off(depth.corrections["cam02"], surfaces[2].pose)[0] < 0.4


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
        poses = [p.pose for p in told], [c.pose for c in found]
        px.append([_off_lines_px(each, true, plates[0].lens) for each in poses])
    # From there, the prior is still about the reported poses.
    there = [replace(s, pose=c.pose) for s, c in zip(surfaces, found)]
    for one, other in zip(found, register_stereo(there, reported, 3.0)):
        assert other.turn_deg == pytest.approx(one.turn_deg, abs=0.05)
    before, after = np.mean(px, axis=0)
    assert after < 0.6 * before


def test_exact_poses_stay_where_stereo_has_found_the_depth() -> None:
    """In any unit."""
    surfaces, scaled = filled(room_plates(4)[0]), []
    for s in surfaces:
        pose = se3(s.pose[:3, :3], 1e-2 * s.pose[:3, 3])
        scaled.append(replace(s, pose=pose, inverse=s.inverse * 100, slope=s.slope * 100))
    for found, surface in zip(register_stereo(scaled, [s.pose for s in scaled], 3e-2), scaled):
        np.testing.assert_allclose(found.pose, surface.pose, atol=1e-12)


# --- stereo ---------------------------------------------------------------------------------------


def _distance_m(plates: Sequence[Surface]) -> float:
    views = [View(str(k), np.zeros((8, 8, 3), np.uint8), p.pose, p.lens) for k, p in enumerate(plates)]
    return scene_box(views).distance_m


def _named(plates: Sequence[Surface]) -> dict[str, Surface]:
    return {str(k): plate for k, plate in enumerate(plates)}


def _swept(plates: Sequence[Surface]) -> PlateStereo:
    stereo = PlateStereo(shared_pool())
    stereo.sweep(_named(plates), _distance_m(plates))
    return stereo


def filled(plates: Sequence[Surface]) -> list[Surface]:
    """The plates with the depth that stereo finds."""
    found = _swept(plates).fill(_named(plates))
    assert found is not None
    return found


def _sweep(plates: Sequence[Surface]) -> NDArray[np.float32]:
    """Depths (N, H, W) of the plates that are as large as the first."""
    found = _swept(plates).inverses(_named(plates))
    assert all(np.isfinite(inverse).all() and (inverse >= 0).all() for inverse in found)
    inverses = np.stack([inverse for inverse in found if inverse.shape == found[0].shape])
    return np.where(inverses > 0, 1.0 / np.maximum(inverses, 1e-12), 0.0).astype(np.float32)


def _changed(plates: list[Surface], change: dict[int, NDArray]) -> list[Surface]:
    """Plates with other colors, by number."""
    return [replace(p, color=np.asarray(change.get(k, p.color), np.float32)) for k, p in enumerate(plates)]


@pytest.mark.parametrize(("count", "share", "median", "right"), [(3, 0.5, 0.015, 0.75), (4, 0.75, 0.01, 0.88)])
def test_most_of_the_room_is_found(count: int, share: float, median: float, right: float) -> None:
    """share: of the pixels with depth; median: relative error; right: share of these within 5 %."""
    plates, truth = room_plates(count)
    found = _sweep(plates)
    there = found > 0
    error = np.abs(found - truth)[there] / truth[there]
    assert there.mean() > share and np.median(error) < median and (error < 0.05).mean() > right


def test_what_is_unknown_has_no_depth_and_says_nothing() -> None:
    plates, _ = room_plates(3, 64)
    known = np.ones((64, 64), bool)
    known[20:50, 20:50] = False
    hidden = [replace(plates[0], known=known), *plates[1:]]
    found = _sweep(hidden)
    assert (found[0][~known] == 0).all() and (found[0][known] > 0).mean() > 0.3
    # Whatever stands there: nothing is compared with it.
    color = plates[0].color.copy()
    color[22:48, 22:48] = np.nan
    np.testing.assert_array_equal(found, _sweep([replace(hidden[0], color=color), *plates[1:]]))


def test_measured_depth_stays_and_holes_are_filled() -> None:
    plates, truth = room_plates(4, 64)
    measured = (1.0 / truth).astype(np.float32)
    measured[:, 10:40, 10:50] = 0.0
    holes = [replace(p, inverse=inverse) for p, inverse in zip(plates, measured)]
    found = np.stack([s.inverse for s in filled(holes)])
    np.testing.assert_array_equal(found[measured > 0], measured[measured > 0])
    there = (measured == 0) & (found > 0)
    assert there.sum() > 0.6 * (measured == 0).sum()
    assert np.median(np.abs(found * truth - 1.0)[there]) < 0.03


def test_a_camera_is_swept_again_where_plates_change_one_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    plates, _ = room_plates(4, 64)
    swept: list[str] = []
    match = PlateStereo._match
    monkeypatch.setattr(PlateStereo, "_match", lambda self, name, of: swept.append(name) or match(self, name, of))
    stereo = _swept(plates)
    assert swept == ["0", "1", "2", "3"]

    def calls(now: Sequence[Surface], count: int) -> tuple[list[str], list[bool]]:
        """Which cameras are swept in some calls, and whether each says that it was the last one due."""
        swept.clear()
        done = [stereo.sweep(_named(now), _distance_m(plates)) for _ in range(count)]
        return list(swept), done

    noise, changed = np.random.default_rng(1).normal(0.0, 1.0, plates[0].color.shape), plates[0].color.copy()
    assert calls(_changed(plates, {2: plates[2].color + noise}), 2) == ([], [False, False])
    changed[:20, :20] = 255.0 - changed[:20, :20]
    now = _changed(plates, {0: changed})
    assert calls(now, 5) == (["0", "1", "2", "3"], [False, False, False, True, False])
    np.testing.assert_array_equal(stereo.inverses(_named(now)), _swept(now).inverses(_named(now)))
    now[3] = replace(plates[3], pose=plates[3].pose + 1e-2 * np.eye(4, k=3))
    assert calls(now, 5)[0] == ["3", "0", "1", "2"]
    assert sorted(calls(now[:3], 4)[0]) == ["0", "1", "2"]  # one is gone
    corrected = [replace(p, pose=p.pose + 2e-3 * np.eye(4, k=3)) for p in now[:3]]  # a calibration: in turn, too
    assert calls(corrected, 4) == (["0", "1", "2"], [False, False, True, False])
    flat = _changed(corrected, {k: np.full((64, 64, 3), 128.0) for k in range(3)})
    assert calls(flat, 4)[0] == ["0", "1", "2"] and stereo.fill(_named(flat)) is None
    assert calls(flat, 1) == ([], [False]), "what found nothing is not tried again"


@pytest.mark.stability
def test_cameras_that_tell_no_depth() -> None:
    """One alone, two at one place, and two that see nothing in common."""
    plates, _ = room_plates(4, 64)
    assert (_sweep(plates[:1]) == 0).all()
    pose = plates[0].pose.copy()
    pose[:3, 3] += 2e-3
    noise = np.random.default_rng(1).normal(0.0, 2.0, plates[0].color.shape)
    same = replace(plates[0], pose=pose)
    assert (_sweep([plates[0], replace(same, color=same.color + noise)]) == 0).all()
    away = plates[0].pose.copy()
    away[:3, 3] += 8.0 * (plates[0].pose[:3, 3] - away[:3, 2])
    away[:3, [0, 2]] *= -1.0
    turned = replace(plates[1], pose=away)
    assert (_sweep([plates[0], turned]) == 0).all()
    # The second of two at one place takes nothing from what the others tell.
    assert (_sweep([*plates, same])[:4] > 0).mean() > 0.98 * (_sweep(plates) > 0).mean()


@pytest.mark.stability
@pytest.mark.parametrize(("level", "noise"), [(0.0, 2.0), (128.0, 0.0), (128.0, 2.0), (255.0, 1.0)])
def test_walls_of_one_color_and_darkness_have_no_depth(level: float, noise: float) -> None:
    plates, _ = room_plates(4, 64)
    rng = np.random.default_rng(2)
    flat = {k: np.clip(level + rng.normal(0.0, noise, (64, 64, 3)), 0.0, 255.0) for k in range(4)}
    assert (_sweep(_changed(plates, flat)) > 0).mean() < 0.01


@pytest.mark.stability
def test_what_no_plate_can_show_costs_its_own_pixels_only() -> None:
    plates, _ = room_plates(4, 64)
    whole = _sweep(plates)
    for bad in (np.nan, np.inf, 1e30):
        broken = _sweep(_changed(plates, {0: np.full((64, 64, 3), bad)}))
        assert (broken[1:] > 0).mean() > 0.5 * (whole[1:] > 0).mean() and (broken[0] > 0).mean() < 0.01
    lens, pose = Pinhole.from_fov(1, 1, 60.0), plates[0].pose
    speck = plate_of(np.full((1, 1, 3), 9, np.uint8), pose, lens)
    assert (_sweep([*plates, speck])[0] > 0).any()
