"""Worlds to learn from: boxes are what is seen, seeds repeat, and what is held out was never drawn."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from camera_node.synthetic.lighting import Light
from camera_node.synthetic.placement import MovingBody, Part, at
from camera_node.synthetic.render import World
from camera_node.synthetic.shapes import Box, Cylinder, RoundCone, Sphere
from camera_node.synthetic.textures import Plain
from edge_server.experiments.training.detector.dataset import LabeledImages, render
from edge_server.experiments.training.detector.scenes import KINDS, Shot, boxes_of, kind_of, own_rig, variation
from freshfield.geometry import Pinhole, look_at

BALL, DRUM = KINDS.index("ball"), KINDS.index("drum")
LIGHT = Light(np.array([[0.0, 0.0, 5.0]]), 0.8, 5.0, (0.4, 0.4, 0.4), (0.6, 0.6, 0.6))


def shot(statics=(), movers=(), kinds=()) -> Shot:
    camera = Pinhole.from_fov(128, 128, 60.0)
    return Shot(World(tuple(statics), tuple(movers), LIGHT), camera, look_at([0, -4, 0], [0, 0, 0]), kinds)


def moving(shape, matrix) -> MovingBody:
    return MovingBody((Part(shape, Plain((1, 0, 0))),), lambda t_s: (at(t_s, 0, 0) @ matrix)[None])


@pytest.mark.parametrize("x, radius", [(0.0, 0.5), (0.7, 0.3), (-1.2, 0.4)])
def test_a_balls_box_is_its_silhouette(x, radius):
    images, boxes = shot([Part(Sphere(radius), Plain((1, 0, 0)), at(x, 0, 0))]).take([0.0])
    # The silhouette's extent in the plane through the axis: directions tangent to the circle.
    centre, half = np.arctan2(x, 4.0), np.arcsin(radius / np.hypot(x, 4.0))
    focal = 64 / np.tan(np.radians(30))
    left, right = (64 + focal * np.tan(centre + s * half) for s in (-1, 1))
    ((a, b, c, d, kind),) = boxes[0]
    assert (a, c) == (pytest.approx(left, abs=0.51), pytest.approx(right, abs=0.51))
    assert kind == BALL and b + d == pytest.approx(128, abs=1.01)
    # It encloses the red pixels and no more.
    red = images[0][..., 0] > 60
    assert red.any(axis=0).sum() == pytest.approx(c - a, abs=2)


def test_what_is_hidden_has_no_box_and_what_is_half_hidden_half_a_box():
    ball = Part(Sphere(0.5), Plain((1, 0, 0)))
    wall = Part(Box((2.0, 0.05, 2.0)), Plain((0, 1, 0)), at(0, -2, 0))
    assert len(shot([ball, wall]).take([0.0])[1][0]) == 0
    half = dataclasses.replace(wall, matrix=at(2.0, -2, 0))
    (whole,), (seen,) = shot([ball]).take([0.0])[1][0], shot([ball, half]).take([0.0])[1][0]
    assert seen[0] == whole[0] and seen[2] == pytest.approx((whole[0] + whole[2]) / 2, abs=1.01)


def test_boxes_follow_what_moves_at_each_instant():
    _, boxes = shot([], [moving(Sphere(0.3), np.eye(4))], (BALL,)).take([-0.5, 0.0, 0.5])
    middles = [(b[0, 0] + b[0, 2]) / 2 for b in boxes]
    assert middles == sorted(middles) and middles[1] == pytest.approx(64, abs=0.6)


def test_a_mover_before_a_still_thing_hides_it():
    near = moving(Sphere(0.6), at(0, -1.5, 0))
    found = shot([Part(Cylinder(0.2, 0.2), Plain((0, 0, 1)))], [near], (BALL,)).take([0.0])[1][0]
    assert found[:, 4].tolist() == [BALL]


def test_a_sliver_is_not_a_thing():
    owner = np.full((40, 40), -1)
    owner[5, :] = 0  # a row
    owner[10:14, 10:14] = 1  # too small
    owner[20:26, 20:27] = 2
    assert boxes_of(owner, [0, 1, 2]).tolist() == [[20, 20, 27, 26, 2]]
    assert boxes_of(owner, [None, None, None]).shape == (0, 5)


def test_shapes_are_kinds():
    assert kind_of(Sphere(1.0), np.eye(4)) == BALL
    assert kind_of(Sphere(1.0), np.diag([0.3, 0.3, 0.5, 1.0])) is None, "a bush"
    assert kind_of(Cylinder(0.2, 0.3), np.eye(4)) == DRUM
    assert kind_of(Cylinder(0.05, 1.0), np.eye(4)) is None, "a pole"
    assert kind_of(RoundCone(0.2, 0.1, 0.5), np.eye(4)) is None


def pictures(seed: int, purpose: str):
    made, rng = variation(seed, purpose, 64)
    return dataclasses.replace(made, supersample=1).take(list(rng.uniform(0, 12, 2)))


def test_a_seed_makes_one_world_and_purposes_share_none():
    first, again = pictures(3, "train"), pictures(3, "train")
    assert (first[0] == again[0]).all() and all((a == b).all() for a, b in zip(first[1], again[1]))
    assert not (first[0] == pictures(3, "held-out")[0]).all()


def test_every_kind_turns_up_and_boxes_lie_in_the_picture():
    seen = set()
    for seed in range(16):
        for boxes in pictures(seed, "train")[1]:
            assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:4] <= 64).all()
            assert (boxes[:, 2:4] - boxes[:, :2] >= 5).all()
            seen |= set(boxes[:, 4].astype(int))
    assert seen == set(range(len(KINDS)))


def test_the_shipped_rigs_show_what_moves_in_them():
    room = own_rig("room", "cam00", 64).take([0.5])[1][0]
    assert KINDS.index("person") in room[:, 4]
    assert len(own_rig("tile", "cam00", 64).take([0.0])[1][0]) > 0


@pytest.mark.slow
def test_pictures_are_rendered_once_and_a_damaged_shard_again(tmp_path):
    first = render("train", 2, 64, 0, tmp_path)
    (shard,) = tmp_path.glob("*.npz")
    written = shard.stat().st_mtime_ns
    again = render("train", 2, 64, 0, tmp_path)
    assert shard.stat().st_mtime_ns == written, "nothing was rendered"
    shard.write_bytes(shard.read_bytes()[:500])
    mended = render("train", 2, 64, 0, tmp_path)
    for other in (again, mended):
        assert isinstance(other, LabeledImages) and len(other) == 16
        assert (other.images == first.images).all()
        assert all((a == b).all() for a, b in zip(other.boxes, first.boxes))
