"""Worlds with and without the object: masks are what is seen, seeds repeat, held-out worlds differ."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edge_server.experiments.training.detector.dataset import LabeledImages, render
from edge_server.experiments.training.detector.object_scenes import VIEWS, ObjectShot, own_shots, variation

SIDE = 48


def taken(seed: int, purpose: str = "train") -> LabeledImages:
    shot = variation(seed, purpose, SIDE)
    scene = dataclasses.replace(shot.scene, params=dataclasses.replace(shot.scene.params, supersample=1))
    return LabeledImages(*ObjectShot(scene, shot.views).take())


@pytest.fixture(scope="module")
def some() -> list[LabeledImages]:
    return [taken(seed) for seed in range(10)]


def test_a_box_is_that_of_the_mask(some):
    for images in some:
        assert images.images.shape == (VIEWS, SIDE, SIDE, 3) and images.masks.shape == (VIEWS, SIDE, SIDE)
        for mask, boxes in zip(images.masks, images.boxes):
            if not len(boxes):
                assert mask.sum() < 5 * SIDE, "of a sliver at most"
                continue
            ((left, top, right, bottom, kind),) = boxes
            rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
            assert (left, top, right, bottom) == (columns[0], rows[0], columns[-1] + 1, rows[-1] + 1)
            assert kind == 0


def test_near_far_cut_off_and_absent_all_turn_up(some):
    masks = np.concatenate([images.masks for images in some])
    share = masks.mean(axis=(1, 2))
    seen = share > 0
    edge = masks[:, [0, -1]].any(axis=(1, 2)) | masks[:, :, [0, -1]].any(axis=(1, 2))
    assert (share > 0.4).any() and ((share < 0.05) & seen).any()
    assert edge.any() and (seen & ~edge).any()
    assert any(not images.masks.any() for images in some), "a world without it"


def test_a_seed_makes_one_world_and_purposes_share_none(some):
    again = taken(3)
    assert np.array_equal(again.images, some[3].images) and np.array_equal(again.masks, some[3].masks)
    assert not np.array_equal(taken(3, "held-out").images, some[3].images)


def test_masks_are_kept_with_the_pictures(tmp_path):
    first = render("train", 1, SIDE, 0, tmp_path, "tile")
    again = render("train", 1, SIDE, 0, tmp_path, "tile")
    assert first.masks.dtype == np.bool_ and first.masks.any()
    for a, b in ((first.images, again.images), (first.masks, again.masks)):
        assert np.array_equal(a, b)
    assert [b.tolist() for b in first.boxes] == [b.tolist() for b in again.boxes]


def test_the_shipped_scenes_are_measured_with_true_masks():
    shots = own_shots(24)
    assert set(shots) >= {"tile", "cell", "scan"}
    scan = ObjectShot(shots["scan"].scene, shots["scan"].views[:2])
    images, boxes, masks = scan.take()
    assert len(images) == 2 and all(len(b) == 1 for b in boxes)
    assert 0.2 < masks.mean() < 0.9, "the bench is not part of it"
