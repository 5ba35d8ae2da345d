"""What is refused before it reaches a field: cameras that cannot be, told by name."""

from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.common.supervision import FARTHEST_M, check_view, moved_pixels
from edge_server.fields.field_constants import CHANGE
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import tiny
from tests.support import refused

VIEW = ring(1, size=16)[0]


def _posed(rotation: np.ndarray, position_m: float = 1.0) -> View:
    pose = VIEW.camera_to_world.copy()
    pose[:3, :3], pose[:3, 3] = rotation, position_m
    return replace(VIEW, camera_to_world=pose)


def _lens(*distortion: float) -> View:
    return replace(VIEW, intrinsics=replace(VIEW.intrinsics, distortion=distortion))


@pytest.mark.parametrize(
    ("view", "text"),
    [
        (_posed(np.zeros((3, 3))), "not orthonormal"),
        (_posed(np.diag([-1.0, 1.0, 1.0])), "right-handed"),
        (_posed(np.eye(3), np.nan), "finite"),
        (_posed(np.eye(3), 1e300), "more than 1e.09 m from the origin"),
        (replace(VIEW, intrinsics=replace(VIEW.intrinsics, fx=5e-324)), "no lens for an image of 16 x 16"),
        (replace(VIEW, intrinsics=replace(VIEW.intrinsics, cy=-16.1)), "principal point .* far outside"),
        (replace(VIEW, image=VIEW.image[:-1]), "16 x 15"),
        (replace(VIEW, image=VIEW.image.astype(np.float32)), "uint8"),
        (_lens(0.0, 0.0, 78.0, 69.6), "distortion"),
        (_lens(1e30, 0.0, 0.0, 0.0), "distortion"),
        (replace(VIEW, weight=np.ones((16, 15), np.float32)), "weight must be float32 of shape .16, 16."),
        *((replace(VIEW, weight=np.full((16, 16), w, np.float32)), "weight must be") for w in (np.nan, 1.5, -0.1)),
    ],
)
def test_cameras_that_cannot_be_are_refused_by_name(view: View, text: str) -> None:
    refused(ValueError, f"camera {VIEW.camera}: .*{text}", check_view, view)


def test_a_geographic_grid_and_a_long_lens_are_welcome() -> None:
    check_view(_posed(np.eye(3), 6e6))
    check_view(_posed(np.eye(3), FARTHEST_M))
    check_view(replace(VIEW, intrinsics=replace(VIEW.intrinsics, fx=1e4, fy=1e4)))
    check_view(replace(VIEW, intrinsics=replace(VIEW.intrinsics, cx=-16.0, cy=32.0)))
    check_view(_lens(-0.046183, 0.139983, 0.000608, 0.00069))


def test_a_field_that_was_given_what_cannot_be_goes_on() -> None:
    field = tiny("ngp")
    refused(ValueError, "camera cam00: its distortion", field.fit, [_lens(1e30, 0.0, 0.0, 0.0)], Budget(steps=2))
    assert field.step == 0 and not field.view_store.memory
    assert field.fit([VIEW], Budget(steps=2)).steps == 2


def test_pixels_move_where_they_change_beyond_the_noise_and_two_around() -> None:
    before = replace(VIEW, image=np.full((16, 16, 3), 90, np.uint8))
    for change, moves in ((CHANGE, False), (CHANGE + 1, True)):
        image = before.image.copy()
        image[4:11, 4:11, 2] += change  # blurring leaves the whole of it to the inner 5 x 5
        moved = moved_pixels(before, replace(before, image=image))
        assert (moved is not None) == moves
    assert moved is not None
    np.testing.assert_array_equal(np.argwhere(moved)[[0, -1]], [[3, 3], [11, 11]])
    assert moved.sum() == 81
