"""What fixed cameras see, against what can be reckoned by hand."""

from xml.etree import ElementTree

import numpy as np
import pytest

from freshfield.coverage import MOST_OBLIQUE_DEG, PLAN, plan_svg, reckon
from freshfield.geometry import Pinhole, look_at
from tests.support import refused

LENS = Pinhole.from_fov(100, 100, 70.0)
# Share of the directions of the sphere within an angle of one of them.
FACING = (1.0 - np.cos(np.deg2rad(MOST_OBLIQUE_DEG))) / 2.0


def camera(azimuth_deg, distance=3.0, height=0.0, lens=LENS):
    a = np.deg2rad(azimuth_deg)
    return lens, look_at((distance * np.sin(a), -distance * np.cos(a), height), (0.0, 0.0, 0.0))


def test_one_camera_sees_what_faces_it():
    found = reckon([camera(0)])
    assert found.seen_by[1] == pytest.approx(FACING, abs=0.02)
    assert found.parallax_deg is None and found.distance_m == pytest.approx(3.0)
    # One more helps most from behind, where it sees as much again.
    assert found.further.pose[:3, 3] @ [0, -1, 0] < -2.0
    assert found.further.seen_by[0] == pytest.approx(1 - 2 * FACING, abs=0.03)


def test_two_opposite_cameras_share_nothing_and_two_at_one_place_everything():
    apart = reckon([camera(0), camera(180)])
    assert apart.seen_by[2] < 0.02  # beside the axis the two are less than 180 degrees apart
    assert apart.seen_by[1] == pytest.approx(2 * FACING, abs=0.03)
    same = reckon([camera(0), camera(0)])
    assert same.seen_by[1] == 0.0 and same.parallax_deg == pytest.approx(0.0, abs=1e-5)
    # The parallax is the angle between the cameras.
    wide, narrow = (reckon([camera(-a), camera(a)]).parallax_deg for a in (20, 10))
    assert wide / narrow == pytest.approx(2.0, rel=0.1) and 30.0 < wide < 45.0
    lens = Pinhole.from_fov(100, 100, 20.0)
    assert reckon([camera(a, lens=lens) for a in (-20, 20)]).seen_by[0] > reckon([camera(-20), camera(20)]).seen_by[0]


def test_the_plan_counts_cameras():
    cameras = [camera(0), camera(90)]
    found = reckon(cameras)
    middle = PLAN // 2
    assert found.plan[middle, middle] == 2 and found.plan.max() == 2 and found.plan.min() == 0
    drawing = ElementTree.fromstring(plan_svg({"a<b": cameras[0], "c": cameras[1]}, found))
    titles = [t.text for t in drawing.iter("{http://www.w3.org/2000/svg}title")]
    assert titles == ["a<b", "c", "one more camera helps most here"]


@pytest.mark.stability
@pytest.mark.parametrize(
    "poses",
    [
        [np.eye(4)],
        [look_at((0, 0, 3.0), (0, 0, 0), (0, 1, 0))] * 2,  # straight down
        [look_at((0, 0, 0), (1, 0, 0)), look_at((0, 0, 0), (-1, 0, 0))],  # away from each other
        [np.eye(4), np.block([[np.eye(3), np.full((3, 1), 1e6)], [np.array([[0, 0, 0, 1.0]])]])],
    ],
)
def test_odd_rigs_give_finite_numbers(poses):
    found = reckon([(LENS, np.asarray(pose, np.float64)) for pose in poses])
    assert sum(found.seen_by) == pytest.approx(1.0) and np.isfinite(found.further.pose).all()
    assert "nan" not in plan_svg({str(k): (LENS, p) for k, p in enumerate(poses)}, found) and "nan" not in found.words
    refused(ValueError, "no camera", reckon, [])
