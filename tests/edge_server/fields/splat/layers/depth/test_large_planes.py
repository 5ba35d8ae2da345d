"""Large planes of the synthetic room, by which depth is continued."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.splat.layers.depth.depth_plate import smooth
from edge_server.fields.splat.layers.depth.large_planes import Plane, continued, large_planes
from edge_server.fields.splat.layers.depth.surfaces import Surface
from tests.edge_server.fields.splat.layers.depth.room_plates import room_plates


@cache
def _surfaces() -> tuple[Surface, ...]:
    plates, depths = room_plates(4, 64)
    smoothed = [smooth((1.0 / d).astype(np.float32), p.color, shared_pool()) for p, d in zip(plates, depths)]
    return tuple(replace(p, inverse=q, slope=slope) for p, (q, slope) in zip(plates, smoothed))


def _planes(surfaces: Sequence[Surface]) -> list[Plane]:
    return large_planes(surfaces, np.random.default_rng(0))


def _opened(surface: Surface) -> Surface:
    inverse = surface.inverse.copy()
    inverse[:24] = 0.0
    return replace(surface, inverse=inverse)


def test_floor_and_walls_are_found_and_no_table() -> None:
    planes = _planes(_surfaces())
    floor = planes[0]
    np.testing.assert_allclose(floor.normal, (0.0, 0.0, 1.0), atol=0.05)
    assert abs(floor.point[2]) < 0.05
    for _, other in planes[1:]:
        assert np.abs(other).max() > 2.5  # walls and ceiling stand three meters apart from the middle; furniture within


def test_what_has_no_depth_gets_that_of_the_nearest_plane_and_the_rest_stays() -> None:
    surfaces = _surfaces()
    planes = _planes(surfaces)
    right = []
    for surface in surfaces:
        found = continued(_opened(surface), planes)
        np.testing.assert_array_equal(found.inverse[24:], surface.inverse[24:])
        right.append(np.abs(found.inverse[:24] / surface.inverse[:24] - 1.0) < 0.05)
    assert np.mean(right) > 0.6


def test_what_the_plate_does_not_know_stays_open() -> None:
    surface = _opened(_surfaces()[0])
    hidden = replace(surface, known=np.zeros_like(surface.known))
    assert (continued(hidden, _planes(_surfaces())).inverse[:24] == 0).all()


@pytest.mark.stability
@pytest.mark.parametrize("unit", [1e-3, 1.0 / 3.0, 2.0, 1e4])
def test_the_unit_of_the_scene_changes_nothing(unit: float) -> None:
    scaled = []
    for surface in _surfaces():
        pose = surface.pose.copy()
        pose[:3, 3] *= unit
        by = np.float32(1.0 / unit)
        scaled.append(replace(surface, pose=pose, inverse=surface.inverse * by, slope=surface.slope * by))
    for one, other in zip(_planes(_surfaces()), _planes(scaled), strict=True):
        np.testing.assert_allclose(other.normal, one.normal, atol=1e-3)
        np.testing.assert_allclose(other.point / unit, one.point, atol=1e-2)


@pytest.mark.stability
def test_no_depth_one_point_and_one_wall() -> None:
    surface = _surfaces()[0]
    nothing = replace(surface, inverse=np.zeros_like(surface.inverse))
    assert _planes([nothing]) == [] and (continued(nothing, []).inverse == 0).all()
    point = nothing.inverse.copy()
    point[5, 5] = 0.5
    assert np.isfinite(continued(nothing, _planes([replace(nothing, inverse=point)])).inverse).all()
    wall = replace(surface, inverse=np.full_like(surface.inverse, 0.5), slope=np.zeros_like(surface.slope))
    (plane,) = _planes([wall])
    np.testing.assert_allclose(np.abs(plane.normal @ surface.pose[:3, 2]), 1.0, atol=1e-6)
