"""Where the scene is, from the cameras alone."""

from dataclasses import replace

import numpy as np
import pytest

from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields.common.background import plain_background
from edge_server.fields.common.scene_box import scene_box
from freshfield.geometry import look_at
from tests.edge_server.fields.scenes import ring

RING = ring(8, size=16)
NOISE = np.random.default_rng(0).integers(0, 256, (8, 16, 16, 3), dtype=np.uint8)
VIEWS = [replace(view, image=image) for view, image in zip(RING, NOISE)]  # surroundings everywhere


def test_the_box_is_where_the_axes_meet() -> None:
    box = scene_box(VIEWS)
    np.testing.assert_allclose(box.center_m, [0, 0, 0.4], atol=1e-6)
    assert box.contracted and 2.0 < box.radius_m < 3.2
    # Nothing is nearer to a lens than two fifths of the way: haze there would fit any picture.
    assert box.near_m == pytest.approx(0.4 * box.distance_m)
    np.testing.assert_allclose(box.normalise(np.array([0, 0, 0.4 + box.radius_m])), [0, 0, 1], atol=1e-6)
    assert box.pixels_across == pytest.approx(2 * replace(box, contracted=False).pixels_across)
    assert box.pixels_across == pytest.approx(4 * box.radius_m / box.distance_m * VIEWS[0].intrinsics.fx)


def test_transparent_pictures_and_a_plain_background_show_an_object() -> None:
    box = scene_box([replace(v, image=np.zeros((16, 16, 4), np.uint8)) for v in VIEWS])
    assert not box.contracted and 0.5 < box.radius_m < 1.3
    color = plain_background(RING)
    assert color is not None and np.abs(color - RING[0].image[0, 0] / 255.0).max() < 0.01
    assert plain_background(VIEWS) is None
    assert not scene_box(RING).contracted
    given = scene_box(VIEWS, (1.0, 2.0, 3.0), 4.0, 0.5, False)
    assert (given.center_m, given.radius_m, given.near_m, given.contracted) == ((1.0, 2.0, 3.0), 4.0, 0.5, False)


def test_parallel_outward_and_single_cameras_have_a_box_too() -> None:
    pose = VIEWS[0].camera_to_world
    one = scene_box(VIEWS[:1])
    ahead = (np.array(one.center_m) - pose[:3, 3]) @ pose[:3, 2]
    assert ahead > 1.0
    eyes = [v.camera_to_world[:3, 3] for v in VIEWS]
    box = scene_box([replace(v, camera_to_world=look_at(eye, 2 * eye)) for v, eye in zip(VIEWS, eyes)])
    assert np.linalg.norm(np.array(box.center_m)[:2]) < 0.2 and np.isfinite(box.radius_m)
    same = [replace(VIEWS[0], camera=str(k)) for k in range(5)]
    assert np.isfinite(scene_box(same).radius_m) and scene_box(same).radius_m > 0


@pytest.mark.parametrize("scene", ["tile", "room"])
@pytest.mark.parametrize("off_m", [30.0, 1e6])
def test_a_camera_that_is_far_away_does_not_move_the_box(scene: str, off_m: float) -> None:
    """Whichever it is, and in whatever direction: ahead, behind and aside of where it looks among them."""
    views = synthetic_still(scene, cameras=13, size=16).training
    expected, rng = scene_box(views), np.random.default_rng(0)
    for k, view in enumerate(views):
        aside = rng.normal(size=3)
        axis = view.camera_to_world[:3, 2]
        for direction in (aside / np.linalg.norm(aside), axis, -axis):
            pose = view.camera_to_world.copy()
            pose[:3, 3] += off_m * direction
            box = scene_box([*views[:k], replace(view, camera_to_world=pose), *views[k + 1 :]])
            moved_m = np.linalg.norm(np.subtract(box.center_m, expected.center_m))
            assert moved_m < 0.15 * expected.radius_m and box.contracted == expected.contracted
            assert box.radius_m == pytest.approx(expected.radius_m, rel=0.2)
