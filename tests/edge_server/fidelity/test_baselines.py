from __future__ import annotations

import numpy as np
import pytest

from edge_server.fidelity.baselines import BaselineMean, baseline, mean_color_db, nearest_view, view_db
from edge_server.fidelity.psnr import PSNR_CEILING_DB
from edge_server.fields import View
from edge_server.run_records import Baseline
from freshfield.geometry import Pinhole, look_at


def view(camera, eye, image=None, target=(0, 0, 0)):
    image = np.zeros((16, 24, 3), np.uint8) if image is None else image
    camera_model = Pinhole.from_fov(image.shape[1], image.shape[0], 60.0)
    return View(camera, image, look_at(eye, target), camera_model)


def test_mean_color_of_black_and_white_views_is_gray():
    images = [np.zeros((8, 8, 3), np.uint8), np.full((20, 4, 3), 255, np.uint8)]
    assert mean_color_db(images, np.full((8, 8, 3), 0.5)) == PSNR_CEILING_DB
    assert mean_color_db(images, np.zeros((8, 8, 3))) == pytest.approx(10 * np.log10(4))
    for size in ((32, 48, 3), (8, 12, 3)):  # a view of another size is resampled
        assert view_db(np.full(size, 80, np.uint8), np.full((16, 24, 3), 80, np.uint8)) == PSNR_CEILING_DB


def test_the_nearest_of_a_ring_is_the_neighbor():
    angles = np.deg2rad(np.arange(0, 360, 30))
    ring = [view(str(i), (3 * np.cos(a), 3 * np.sin(a), 1)) for i, a in enumerate(angles)]
    held_out = look_at((3 * np.cos(0.6), 3 * np.sin(0.6), 1), (0, 0, 0))  # 34 degrees
    assert nearest_view(ring, held_out).camera == "1"
    here = (1.0, 0.0, 0.0)  # at one place the viewing direction decides
    views = [view("away", here, target=(9, 0, 0)), view("same", here, target=(-1, 0.1, 0))]
    assert nearest_view(views, look_at(here, (-1, 0, 0))).camera == "same"


def test_both_together_and_none_without_views():
    truth = np.full((16, 24, 3), 128, np.uint8)
    found = baseline([view("a", (2, 0, 0)), view("b", (0, 2, 0), truth)], truth, look_at((0, 2.1, 0), (0, 0, 0)))
    assert found.nearest_view_db == PSNR_CEILING_DB
    assert found.mean_color_db == pytest.approx(-20 * np.log10(64 / 255))
    mean = BaselineMean()
    assert mean.mean == Baseline()
    for each in (found, Baseline(1.0, 2.0), Baseline(3.0, 7.0)):
        mean.add(each)
    expected = (found.mean_color_db + 4.0) / 3, (found.nearest_view_db + 9.0) / 3
    assert (mean.mean.mean_color_db, mean.mean.nearest_view_db) == pytest.approx(expected)
    empty = baseline([], truth, np.eye(4))
    assert (empty.mean_color_db, empty.nearest_view_db) == (None, None)
