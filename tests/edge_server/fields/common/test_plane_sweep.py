"""Depth that a plane sweep finds in the pictures, and what it is worth as a guide."""

from dataclasses import replace

import numpy as np
import pytest

from edge_server.experiments.scenes.multiview_still import synthetic_still
from edge_server.fields import Budget, View
from edge_server.fields.common.background import foreground_mask
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.plane_sweep import _square_centers, depth_guide
from edge_server.fields.common.scene_box import SceneBox, scene_box
from edge_server.fields.common.supervision import pack_views
from edge_server.fields.common.threads.thread_pool import shared_pool
from edge_server.fields.field_constants import GUIDE_RAYS
from tests.edge_server.fields.scenes import ring, seen
from tests.edge_server.fields.small import SEEN, SMALL, cut_out, small


def _packed(views: list[View]) -> tuple[Views, SceneBox]:
    box = scene_box(views, None, None, None, None)
    return pack_views(views, box, {}), box


def _guide(views: list[View], data: Views, box: SceneBox, threads: int = 2) -> np.ndarray:
    return depth_guide(SMALL["ngp"], shared_pool(threads), box, views, data)


@pytest.mark.parametrize("size", [48, 131])
def test_depth_is_where_the_scene_is(size: int) -> None:
    """At 131 pixels, one speaks for several, and they are no multiple of these."""
    views = ring(12, size)
    data, box = _packed(views)
    assert (size > 48) == (data.first[-1] > GUIDE_RAYS)
    found = _guide(views, data, box)
    assert found.shape == (data.first[-1],) and found.dtype == np.float32
    truth = np.concatenate([seen(v.intrinsics, v.camera_to_world)[1].reshape(-1) for v in views]) / box.radius_m
    told, there = found > 0, np.isfinite(truth)
    assert told[there].mean() > 0.5, "most of what can be seen has a guide"
    assert told[~there].mean() < 0.01, "and next to none of the plain sky"
    wrong = np.abs(found - truth)[told & there] / truth[told & there]
    # Before an area of one color, every place that all see in that area agrees as well.
    assert np.median(wrong) < 0.05 and np.mean(wrong < 0.1) > 0.6
    grown = [replace(v, camera_to_world=v.camera_to_world.copy()) for v in views]
    for view in grown:
        view.camera_to_world[:3, 3] *= 100.0
    data, larger = _packed(grown)
    assert larger.radius_m == pytest.approx(100.0 * box.radius_m)
    assert np.mean(np.isclose(_guide(grown, data, larger), found, rtol=1e-3)) > 0.99, "in units of the scene"


@pytest.mark.parametrize(("height", "width", "side"), [(5, 7, 1), (6, 8, 2), (7, 10, 3), (9, 13, 4), (2, 5, 4)])
def test_a_pixel_speaks_for_the_square_that_it_lies_in_the_middle_of(height: int, width: int, side: int) -> None:
    y, x = np.divmod(_square_centers(height, width, side), width)
    for found, axis, length in ((y, 0, height), (x, 1, width)):
        at = np.moveaxis(found, axis, 0)[:, 0]
        assert len(at) == -(-length // side) and (np.moveaxis(found, axis, 0) == at[:, None]).all()
        assert at.tolist() == [min(k * side + side // 2, length - 1) for k in range(len(at))]


def test_what_is_transparent_or_of_one_color_has_no_depth() -> None:
    views = [cut_out(v) for v in SEEN]
    data, box = _packed(views)
    found, sky = _guide(views, data, box), data.pixels[:, 3] < 16
    assert (found[~sky] > 0).mean() > 0.5 and (found[sky] == 0).all()
    views = [replace(v, image=np.full_like(v.image, 128)) for v in SEEN]
    assert (_guide(views, *_packed(views)) == 0).all()


def _silent(view: View) -> View:
    return replace(view, weight=np.zeros(view.image.shape[:2], np.float32))


def test_what_is_nearly_transparent_or_nearly_of_the_plain_color_is_empty() -> None:
    clear = np.zeros((1, 3, 4), np.uint8)
    clear[..., 3] = 15, 16, 255
    assert foreground_mask(clear, None).tolist() == [[False, True, True]]
    plain = np.array([0.2, 0.4, 0.6], np.float32)
    near = np.array([[(51, 102, 153), (54, 99, 162), (55, 99, 162)]], np.uint8)  # 0, 15 and 16 of 255 off in all
    assert foreground_mask(near, plain).tolist() == [[False, False, True]]
    assert foreground_mask(near, None).all()


def test_two_views_have_none_and_those_of_no_weight_no_say() -> None:
    two, where = _packed(SEEN[:2])
    assert _guide(SEEN[:2], two, where).size == 0
    most = [*SEEN[:2], *map(_silent, SEEN[2:])]
    assert _guide(most, *_packed(most)).size == 0
    # What a picture of no weight shows changes nothing for the others.
    silent = [_silent(v) if k == 3 else v for k, v in enumerate(SEEN)]
    wrong = [replace(v, image=255 - v.image) if k == 3 else v for k, v in enumerate(silent)]
    data, box = _packed(silent)
    found = [_guide(views, _packed(views)[0], box)[: data.first[3]] for views in (silent, wrong)]
    np.testing.assert_array_equal(*found)


def _weight(views: list[View], **changed: float) -> float:
    field = small("ngp", **changed)
    field.fit(views, Budget(steps=1))
    return field._present_guide_weight()


def test_it_is_used_where_it_is_called_for() -> None:
    """A plain background or few cameras; elsewhere it would only take its time. It falls to nothing."""
    room = synthetic_still("room", cameras=13, size=32).training
    assert _weight(room) == _weight(SEEN, depth_guide=0.0) == 0.0 < _weight(room[::2])
    field, weights = small("ngp", guide_steps=4), []
    for _ in range(5):
        field.fit(SEEN, Budget(steps=1))
        weights.append(field._present_guide_weight())
    np.testing.assert_allclose(weights, [0.075, 0.05, 0.025, 0.0, 0.0])
