"""Large planes of the synthetic room, by which depth is continued."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields.splat.layers.depth.large_planes import Plane, continued, large_planes
from edge_server.fields.splat.layers.depth.surfaces import Surface
from tests.edge_server.fields.splat.layers.depth.room_plates import room_surfaces


def _planes(surfaces: Sequence[Surface]) -> list[Plane]:
    return large_planes(surfaces, np.random.default_rng(0))


def _opened(surface: Surface) -> Surface:
    inverse = surface.inverse.copy()
    inverse[:24] = 0.0
    return replace(surface, inverse=inverse)


def test_floor_and_walls_are_found_and_no_table() -> None:
    planes = _planes(room_surfaces(4, 64))
    floor = planes[0]
    np.testing.assert_allclose(floor.normal, (0.0, 0.0, 1.0), atol=0.05)
    assert abs(floor.point[2]) < 0.05
    for _, other in planes[1:]:
        assert np.abs(other).max() > 2.5  # walls and ceiling stand three meters apart from the middle; furniture within


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
