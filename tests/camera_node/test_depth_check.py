"""Right depth passes; wrong units, constants, wrong places and wrong images are told, and of which camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from camera_node.depth_check import DepthView, check, edge_contrast, first_views
from camera_node.settings import source_config
from camera_node.synthetic import make_scene
from camera_node.synthetic.depth import DepthRenderer
from camera_node.synthetic.effects.depth_sensor import DepthSensor
from freshfield.depth import DepthImage
from freshfield.geometry import Pinhole, Pose, se3_inverse, so3_exp
from freshfield.scenario import load

APART = np.eye(4)
APART[:3, :3], APART[:3, 3] = so3_exp([0.0, 0.05, 0.0]), (-0.03, 0.0, 0.01)


@cache
def rig() -> tuple[DepthView, ...]:
    """Four cameras of the room with depth sensors; that of the last stands beside its camera."""
    scene = make_scene("room", {"supersample": 1})
    views = []
    for n in range(1, 5):
        lens, pose = scene.cameras[f"cam{n:02d}"]
        image = scene.render(f"cam{n:02d}", 1.0)
        sensor = DepthSensor().start(np.random.default_rng(n))
        if n < 4:
            measured = sensor.measure(DepthRenderer(scene.world, lens, pose).depth(1.0), image, lens, 0)
        else:
            small = Pinhole.from_fov(96, 80, 66.0)
            exact = DepthRenderer(scene.world, small, pose @ APART).depth(1.0)
            counts = np.rint(exact * 1e4).astype(np.uint16)
            measured = DepthImage(counts, 1e-4, small, Pose.from_matrix(APART))
        views.append(DepthView(f"cam{n:02d}", image, lens, Pose.from_matrix(pose), measured))
    return tuple(views)


def said(views: list[DepthView]) -> list[str]:
    lines = []
    for view in views:
        try:
            lines.append(check(view, [other for other in views if other is not view]))
        except ValueError as error:
            assert "\n" not in str(error)
            lines.append(f"WRONG {error}")
    return lines


def recounted(view: DepthView, change: Callable[[np.ndarray], np.ndarray]) -> DepthView:
    return replace(view, depth=replace(view.depth, counts=change(view.depth.counts).astype(np.uint16)))


def moved(view: DepthView, by: np.ndarray) -> DepthView:
    return replace(view, pose=Pose.from_matrix(view.pose.matrix() @ by))


def test_right_depth_is_described():
    lines = said(list(rig()))
    assert all("of it agrees with cam0" in line and "WRONG" not in line for line in lines), lines
    assert lines[0].startswith("128 x 128, ") and " without depth, 1.3 to 6.3 m" in lines[0]
    for view in rig()[:3]:
        assert "its edges are those of the image" in check(view, [])


@pytest.mark.stability
@pytest.mark.parametrize(
    ("change", "told"),
    [
        (lambda v: v.scaled(0.1), "that of cam01 seems to be 0.1 times what it should be: is the unit wrong"),
        (lambda v: v.scaled(0.3048), "that of cam01 seems to be 0.305 times"),
        (lambda v: recounted(v, lambda c: np.where(c > 0, 3000, 0)), "nearly all of it is the same, 3 m"),
        (lambda v: recounted(v, np.zeros_like), "100% without depth: is the scene within the sensor's range"),
        (lambda v: recounted(v, lambda c: np.where(c > 0, 8000 - c, 0)), "are near and far exchanged"),
        (lambda v: recounted(v, lambda c: c[:, ::-1]), "is the pose, a lens"),
        (lambda v: moved(v, se3_inverse(v.pose.matrix())), "is the pose, a lens"),
    ],
    ids=["a tenth", "feet", "constant", "holes", "inverted", "mirrored", "nowhere"],
)
def test_wrong_depth_is_told_of_the_camera_that_has_it(change, told):
    first, *others = rig()
    lines = said([change(first), *others])
    assert lines[0].startswith("WRONG") and told in lines[0], lines[0]
    assert not any(line.startswith("WRONG") for line in lines[1:]), lines


@pytest.mark.stability
def test_of_two_cameras_the_one_with_another_unit_is_named_by_both_and_one_alone_by_its_edges():
    lines = said([rig()[0].scaled(0.1), rig()[1]])
    assert all("that of cam01 seems to be 0.1 times what it should be" in line for line in lines), lines
    mirrored = [recounted(view, lambda c: c[:, ::-1]) for view in rig()[:3]]
    lines = [line for view in mirrored for line in said([view])]
    assert sum("its edges are not those of the image" in line for line in lines) >= 2, lines


@pytest.mark.stability
@pytest.mark.filterwarnings("error")
def test_cameras_that_see_nothing_in_common_and_blank_images_are_described():
    away = replace(rig()[1], pose=Pose((1.0, 0.0, 0.0, 0.0), (500.0, 0.0, 0.0)))
    blank = replace(rig()[0], image=np.zeros_like(rig()[0].image))
    line = check(blank, [away])
    assert line.startswith("128 x 128, ") and "agrees" not in line and "edges" not in line
    pixel = DepthImage(np.full((1, 1), 900, np.uint16), 0.001)
    with pytest.raises(ValueError, match="nearly all of it is the same"):
        check(replace(blank, depth=pixel), [away])


@pytest.mark.parametrize(("count", "is_said"), [(199, False), (200, True)])
def test_edges_of_fewer_than_200_pixels_say_nothing(count, is_said):
    halves, lens = np.indices((count, 64))[1] // 32, Pinhole.from_fov(64, count, 60.0)
    image = np.repeat(200 * halves[..., None], 3, axis=-1).astype(np.uint8)
    depth = DepthImage((1000 + 1000 * halves).astype(np.uint16), 0.001)
    found = edge_contrast(DepthView("cam01", image, lens, Pose.from_matrix(np.eye(4)), depth))
    assert (found is not None) == is_said


@pytest.mark.parametrize(("name", "cameras"), [("duo", ["cam01", "cam02"]), ("room", [])])
def test_scenarios_are_examined_where_they_have_depth(name, cameras):
    scenario = load(name)
    assert [view.camera for view in first_views(scenario, source_config(scenario), None)] == cameras
