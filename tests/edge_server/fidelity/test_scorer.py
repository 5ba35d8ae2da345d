from __future__ import annotations

import itertools

import numpy as np
import pytest

from edge_server.fidelity.baselines import BaselineMean, baseline, mean_color_db, nearest_view, view_db
from edge_server.fidelity.images import ImageError
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.psnr import PSNR_CEILING_DB, psnr
from edge_server.fidelity.scorer import Scorer, mean_score
from edge_server.fidelity.ssim import ssim
from edge_server.fields import View
from edge_server.run_records import Baseline
from freshfield.geometry import Pinhole, look_at
from tests.conftest import data_dir


def test_a_score_has_every_metric_of_the_whole_image_and_of_its_parts():
    truth = np.full((16, 16, 3), 0.5)
    earlier, shown = truth.copy(), truth.copy()
    earlier[:4] = 0.6
    shown[:4] += 0.1
    shown[4:] += 0.01
    score = Scorer().score("h", shown, 7_000_000, truth, 5_000_000, [earlier])
    assert (score.camera, score.published_ns, score.truth_gap_ms, score.on) == ("h", 7_000_000, -2.0, "held-out")
    assert (score.psnr_moving_db, score.psnr_still_db) == (pytest.approx(20.0), pytest.approx(40.0))
    assert score.psnr_db == pytest.approx(-10 * np.log10((0.01 + 3 * 0.0001) / 4))
    assert score.moving_share == 0.25 and 0.0 < score.ssim < 1.0
    clear = np.zeros((16, 16, 4), np.uint8)  # a truth with alpha lies over the background
    white = Scorer(background=(1.0, 1.0, 1.0)).score("h", np.ones((16, 16, 3)), 0, clear, 0)
    assert white.psnr_db == PSNR_CEILING_DB
    quick = Scorer().score("h", shown, 0, truth, 0, psnr_only=True)
    assert (quick.psnr_db, quick.psnr_moving_db, quick.ssim) == (score.psnr_db, None, None)


def test_selected_views_are_averaged_and_say_so():
    gray = np.full((32, 32, 3), 128, np.uint8)
    off = (gray / 255 + 0.1).astype(np.float32)
    score = Scorer().score_selected([("a", gray / 255, gray), ("b", off, gray)], 5_000_000)
    assert score.on == "selected" and score.truth_gap_ms is None and score.camera == "a,b"
    assert score.psnr_db == pytest.approx((PSNR_CEILING_DB + 20.0) / 2, abs=1e-4)
    assert score.psnr_moving_db is None
    assert Scorer().score_selected([], 0) is None


def test_the_mean_over_cameras_skips_what_a_camera_lacks():
    gray = np.full((16, 16, 3), 0.5)
    scorer = Scorer()
    a = scorer.score("a", gray, 0, gray + 0.1, 0, [gray])
    b = scorer.score("b", gray[:8], 0, gray[:8] + 0.1, 0)
    mean = mean_score([a, b])
    assert mean.ssim == a.ssim and b.ssim is None and mean.psnr_moving_db == pytest.approx(20.0)
    assert mean.camera == "a,b"


@pytest.mark.parametrize("size", [(1, 40), (10, 10), (11, 11), (31, 31)])
def test_tiny_images_are_scored_as_far_as_the_metrics_go(size):
    image = np.random.default_rng(0).random((*size, 3))
    score = Scorer(open_lpips(data_dir("lpips"))[0]).score("h", image, 0, image, 0, [1 - image])
    assert score.psnr_db == PSNR_CEILING_DB
    assert score.ssim == (None if min(size) < 11 else pytest.approx(1.0))
    assert score.lpips == (None if min(size) < 31 else 0.0)


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


RNG = np.random.default_rng(9)
HARD = {
    "black": np.zeros((40, 40, 3)),
    "white": np.ones((40, 40, 3)),
    "subnormal": np.full((40, 40, 3), 5e-324),
    "one pixel": np.pad(np.ones((1, 1, 3)), ((20, 19), (20, 19), (0, 0))),
    "checkers": np.indices((40, 40)).sum(0)[..., None].repeat(3, 2) % 2 * 1.0,
    "noise": RNG.random((40, 40, 3)),
    "one channel": np.concatenate([np.ones((40, 40, 1)), np.zeros((40, 40, 2))], axis=2),
}


@pytest.mark.stability
def test_every_pair_scores_finite_and_in_range_and_equal_images_score_the_most():
    lpips = open_lpips(data_dir("lpips"))[0]
    for one, other in itertools.product(HARD, HARD):
        a, b = HARD[one], HARD[other]
        assert 0.0 <= psnr(a, b) <= PSNR_CEILING_DB, (one, other)
        assert -1.0 <= ssim(a, b) <= 1.0 and 0.0 <= lpips(a, b) < np.inf, (one, other)
        if one == other:
            assert psnr(a, b) == PSNR_CEILING_DB and ssim(a, b) == pytest.approx(1.0, abs=1e-9), one
            assert lpips(a, b) == 0.0, one


@pytest.mark.stability
@pytest.mark.parametrize("poison", [np.nan, np.inf])
@pytest.mark.parametrize("which", ["rendering", "held-out frame"])
def test_poison_is_refused_by_name_and_never_scored(poison, which):
    good, bad = np.full((40, 40, 3), 0.5, np.float32), np.full((40, 40, 3), 0.5, np.float32)
    bad[-1, -1, -1] = poison
    pair = (bad, good) if which == "rendering" else (good, bad)
    with pytest.raises(ImageError, match=f"{which}.*row 39, column 39"):
        Scorer().score("h", pair[0], 0, pair[1], 0)
