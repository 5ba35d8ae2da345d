"""Depth of plates by stereo, against the exact depth of the synthetic room."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.scene_box import scene_box
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.layers.depth.plate_stereo import PlateStereo
from edge_server.fields.splat.layers.depth.surfaces import Surface
from freshfield.geometry import Pinhole
from tests.edge_server.fields.splat.layers.depth.room_plates import plate_of, room_plates

Plates = list[Surface]


def _distance_m(plates: Sequence[Surface]) -> float:
    views = [View(str(k), np.zeros((8, 8, 3), np.uint8), p.pose, p.lens) for k, p in enumerate(plates)]
    return scene_box(views).distance_m


def _named(plates: Sequence[Surface]) -> dict[str, Surface]:
    return {str(k): plate for k, plate in enumerate(plates)}


def _swept(plates: Sequence[Surface]) -> PlateStereo:
    stereo = PlateStereo(shared_pool())
    stereo.sweep(_named(plates), _distance_m(plates))
    return stereo


def filled(plates: Sequence[Surface]) -> Plates:
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


def _changed(plates: Plates, change: dict[int, NDArray]) -> Plates:
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


def _marked(plate: Surface, size: int) -> Surface:
    color = plate.color.copy()
    color[:size, :size] = 255.0 - color[:size, :size]
    return replace(plate, color=color)


def test_a_camera_is_swept_again_where_plates_change_one_a_call(monkeypatch: pytest.MonkeyPatch) -> None:
    plates, _ = room_plates(4, 64)
    swept: list[str] = []
    match = PlateStereo._match
    monkeypatch.setattr(
        PlateStereo, "_match", lambda self, name, lenses: swept.append(name) or match(self, name, lenses)
    )
    stereo = _swept(plates)
    assert swept == ["0", "1", "2", "3"]

    def calls(now: Sequence[Surface], count: int) -> tuple[list[str], list[bool]]:
        """Which cameras are swept in some calls, and whether each says that it was the last one due."""
        swept.clear()
        done = [stereo.sweep(_named(now), _distance_m(plates)) for _ in range(count)]
        return list(swept), done

    noise = np.random.default_rng(1).normal(0.0, 1.0, plates[0].color.shape)
    for alike in ([_marked(plates[0], 3), *plates[1:]], _changed(plates, {2: plates[2].color + noise})):
        assert calls(alike, 2) == ([], [False, False])
    changed = [_marked(plates[0], 20), *plates[1:]]
    assert calls(changed, 5) == (["0", "1", "2", "3"], [False, False, False, True, False])
    np.testing.assert_array_equal(stereo.inverses(_named(changed)), _swept(changed).inverses(_named(changed)))
    moved = [*changed[:3], replace(plates[3], pose=plates[3].pose + 1e-2 * np.eye(4, k=3))]
    assert calls(moved, 5)[0] == ["3", "0", "1", "2"]
    assert sorted(calls(moved[:3], 4)[0]) == ["0", "1", "2"]  # one is gone
    corrected = [replace(p, pose=p.pose + 2e-3 * np.eye(4, k=3)) for p in moved[:3]]  # a calibration: in turn, too
    assert calls(corrected, 4) == (["0", "1", "2"], [False, False, True, False])


def test_what_found_nothing_is_not_tried_again(monkeypatch: pytest.MonkeyPatch) -> None:
    plates, _ = room_plates(3, 32)
    flat = _changed(plates, {k: np.full((32, 32, 3), 128.0) for k in range(3)})
    stereo = _swept(flat)
    assert stereo.fill(_named(flat)) is None
    monkeypatch.setattr(PlateStereo, "_match", None)
    assert not stereo.sweep(_named(flat), _distance_m(plates)) and stereo.fill(_named(flat)) is None


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
