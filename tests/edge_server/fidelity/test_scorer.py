"""Scores of images: PSNR, SSIM, LPIPS, moving pixels, baselines, and what is no image."""

import itertools
import sys

import cv2
import numpy as np
import pytest
import torch
from torch.nn.functional import adaptive_avg_pool2d

from edge_server.cli import main as edge_server
from edge_server.fidelity import fetch_lpips_command, lpips_network
from edge_server.fidelity.baselines import BaselineMean, baseline, mean_color_db, nearest_view, view_db
from edge_server.fidelity.fetch_lpips_command import FetchError, convert
from edge_server.fidelity.fidelity_constants import MOVING_BOUND, PSNR_CEILING_DB
from edge_server.fidelity.images import ImageError
from edge_server.fidelity.lpips_weights import FILES, FOLDER_VARIABLE, open_lpips, weights_folder
from edge_server.fidelity.moving_pixels import NoiseEstimate, frames_at_lags, moving_mask
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.scorer import Scorer, mean_score
from edge_server.fidelity.ssim import ssim
from edge_server.fields import View
from edge_server.run_records import Baseline
from freshfield.geometry import Pinhole, look_at
from tests.conftest import data_dir
from tests.support import refusal, refused

MS = 1_000_000


def test_a_pixel_moves_if_any_channel_of_any_earlier_frame_differs():
    now = np.full((4, 4, 3), 0.5)
    one, two = now.copy(), now.copy()
    one[0, 0, 2] += 1.1 * MOVING_BOUND
    two[3, 3, 1] -= 1.1 * MOVING_BOUND
    two[1, 1] += 0.9 * MOVING_BOUND
    assert list(zip(*np.nonzero(moving_mask(now, [one, two])))) == [(0, 0), (3, 3)]
    assert not moving_mask(now, []).any(), "without earlier frames nothing is known to move"


def test_frames_are_chosen_nearest_to_their_lags_without_repeats():
    times = [i * 100 * MS for i in range(11)]  # ten frames a second, present at 1000 ms
    assert frames_at_lags(times, 1000 * MS) == [9, 8, 7]  # 60 and 120 ms ago share the frame of 900 ms
    assert frames_at_lags(times, 0) == []
    assert frames_at_lags([0], 5 * MS) == [0]


@pytest.mark.parametrize("sigma", [0.001, 0.004, 0.02])
def test_noise_is_measured_through_8_bits_and_a_moving_third(sigma):
    rng = np.random.default_rng(3)
    scene = np.clip(rng.random((12, 16, 3)).repeat(8, 0).repeat(8, 1), 0.2, 0.8)
    estimate = NoiseEstimate()
    frames = []
    for i in range(6):
        moved = scene.copy()
        moved[:, :40] = np.roll(scene[:, :40], i * 5, axis=0)
        noisy = moved + rng.normal(0, sigma, scene.shape)
        frames.append(np.round(noisy * 255).astype(np.uint8))
    for a, b in itertools.pairwise(frames):
        estimate.add(a, b)
    # Rounding to 8 bits is noise too: 1/sqrt(12) of a step, though none where noise is far below a step.
    upper = np.hypot(sigma, 1 / 255 / np.sqrt(12))
    assert 0.6 * sigma <= estimate.sigma <= 1.05 * upper
    assert estimate.bound == max(MOVING_BOUND, 4 * estimate.sigma)


RNG = np.random.default_rng(5)


def test_8_bit_floating_and_transparent_images_agree():
    truth = RNG.integers(0, 256, (12, 12, 3), dtype=np.uint8)
    rendering = RNG.integers(0, 256, (12, 12, 3), dtype=np.uint8)
    assert psnr((rendering / 255).astype(np.float32), truth) == pytest.approx(psnr(rendering, truth), abs=1e-4)
    rgba = np.zeros((4, 4, 4), np.uint8)
    rgba[..., 0] = 255
    assert psnr(rgba, np.zeros((4, 4, 3))) == PSNR_CEILING_DB  # transparent red on black is black
    assert psnr(np.full((4, 4, 3), 1.7), np.ones((4, 4, 3))) == PSNR_CEILING_DB  # clipped, as a screen does


def test_a_mask_restricts_the_mean_and_an_empty_one_gives_nothing():
    truth = np.zeros((4, 4, 3))
    rendering = truth.copy()
    rendering[0, 0] = 0.1
    mask = np.zeros((4, 4), bool)
    assert psnr(rendering, truth, mask) is None
    mask[0, 0] = True
    assert psnr(rendering, truth, mask) == pytest.approx(20.0)
    mask[1, 1] = True
    assert psnr(rendering, truth, mask) == pytest.approx(20.0 + 10 * np.log10(2))


def test_what_is_no_image_is_refused_by_name():
    wrong = [(np.zeros(shape), "rendering.*shape") for shape in ((4, 4), (0, 4, 3), (4, 4, 2))]
    wrong += [(np.zeros((4, 4, 3), np.int32), "rendering.*int32"), (np.zeros((4, 5, 3)), "5 x 4.*4 x 4")]
    for image, said in wrong:
        refused(ImageError, said, psnr, image, np.zeros((4, 4, 3)))


def reference_ssim(a, b, mask=None):
    """(3.33) window by window, with an explicit 11 x 11 Gaussian: slow, and nothing to get wrong."""
    x = np.arange(-5, 6)
    w = np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 1.5**2))
    w /= w.sum()
    values = []
    for channel in range(3):
        for row in range(a.shape[0] - 10):
            for column in range(a.shape[1] - 10):
                if mask is not None and not mask[row : row + 11, column : column + 11].all():
                    continue
                p = a[row : row + 11, column : column + 11, channel]
                q = b[row : row + 11, column : column + 11, channel]
                mp, mq = (w * p).sum(), (w * q).sum()
                vp, vq = (w * (p - mp) ** 2).sum(), (w * (q - mq) ** 2).sum()
                cov = (w * (p - mp) * (q - mq)).sum()
                c1, c2 = 0.01**2, 0.03**2
                values.append((2 * mp * mq + c1) * (2 * cov + c2) / ((mp**2 + mq**2 + c1) * (vp + vq + c2)))
    return float(np.mean(values))


def test_it_equals_the_definition_and_a_mask_leaves_the_windows_that_lie_wholly_within_it():
    a, b = np.random.default_rng(5).random((2, 40, 37, 3))
    assert ssim(a, b) == pytest.approx(reference_ssim(a, b), abs=1e-9)
    assert ssim(a[:11, :11], b[:11, :11]) == pytest.approx(reference_ssim(a[:11, :11], b[:11, :11]), abs=1e-9)
    mask = np.ones((40, 37), bool)
    mask[:9, 3] = mask[30, :20] = mask[39, 36] = False
    assert ssim(a, b, mask) == pytest.approx(reference_ssim(a, b, mask), abs=1e-9)
    assert ssim(a, b, np.ones_like(mask)) == ssim(a, b)
    mask[:] = False
    mask[4:15, 20:31] = True
    assert ssim(a, b, mask) == pytest.approx(reference_ssim(a[4:15, 20:31], b[4:15, 20:31]), abs=1e-9)
    mask[4, 20] = False
    assert ssim(a, b, mask) is None
    refused(ImageError, "at least 11 x 11", ssim, a[:10], b[:10])


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
    white = Scorer(background=(1.0, 1.0, 1.0)).score("h", np.ones((16, 16, 3)), 0, clear, 0, [clear])
    assert (white.psnr_db, white.moving_share) == (PSNR_CEILING_DB, 0.0)
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


HARD = {name: np.full((40, 40, 3), v) for name, v in (("black", 0.0), ("white", 1.0), ("subnormal", 5e-324))} | {
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
    refused(ImageError, f"{which}.*row 39, column 39", Scorer().score, "h", pair[0], 0, pair[1], 0)


def example(name):
    return cv2.imread(str(data_dir("lpips") / f"ex_{name}.png"))[..., ::-1]


def test_values_published_with_the_weights():
    """Of the authors' example images."""
    lpips, _ = open_lpips(data_dir("lpips"))
    assert lpips(example("p0"), example("ref")) == pytest.approx(0.7219, abs=1e-4)
    assert lpips(example("p1"), example("ref")) == pytest.approx(0.1376, abs=1e-4)
    assert lpips(example("ref"), example("ref")) == 0.0
    assert lpips.minimum_side == 31
    refused(ImageError, r"LPIPS needs .* 31 x 31", lpips, np.zeros((30, 64, 3)), np.ones((30, 64, 3)))


def test_a_mask_blackens_the_rest_and_weighs_each_cell_of_a_slice_by_its_share():
    lpips, _ = open_lpips(data_dir("lpips"))
    a, b = np.random.default_rng(3).random((2, 64, 96, 3))
    mask = np.ones((64, 96), bool)
    mask[:, 70:] = mask[50:, :10] = False
    distance, black = lpips(a, b, mask), (a * mask[..., None], b * mask[..., None])
    assert distance == lpips(*black, mask) != pytest.approx(lpips(*black), rel=0.01)
    assert lpips(a, b, np.ones_like(mask)) == pytest.approx(lpips(a, b), abs=1e-12)
    parameters, expected = {name: torch.from_numpy(array) for name, array in lpips._parameters.items()}, 0.0
    x = torch.from_numpy(np.stack(black).astype(np.float32).transpose(0, 3, 1, 2)) * 2 - 1
    x = (x - torch.tensor(lpips_network.SHIFT).view(3, 1, 1)) / torch.tensor(lpips_network.SCALE).view(3, 1, 1)
    for found, weights in zip(lpips_network._slices(parameters, x), lpips._lin):
        unit = (found / found.norm(dim=1, keepdim=True).clamp_min(1e-9)).double().numpy()
        map_ = ((unit[0] - unit[1]) ** 2 * weights[:, None, None]).sum(0)
        share = adaptive_avg_pool2d(torch.from_numpy(mask.astype(float))[None], map_.shape)[0].numpy()
        expected += np.average(map_, weights=share)
    assert distance == pytest.approx(expected, rel=1e-4)


def test_the_weights_folder_is_the_nearest_that_was_named(tmp_path, monkeypatch):
    data, named = tmp_path / "data", tmp_path / "named"
    monkeypatch.delenv(FOLDER_VARIABLE, raising=False)
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    lpips, reason = open_lpips()
    assert lpips is None and "--lpips" in reason and FOLDER_VARIABLE in reason
    assert weights_folder() is None and weights_folder(None, data) is None
    (data / "lpips").mkdir(parents=True)
    assert weights_folder(None, data) == data / "lpips"
    monkeypatch.setenv("FRESHFIELD_DATA", str(data))
    assert weights_folder() == data / "lpips"
    monkeypatch.setenv(FOLDER_VARIABLE, str(named))
    assert weights_folder(None, data) == named and weights_folder(tmp_path, data) == tmp_path


def test_torn_and_wrong_weights_give_a_reason_and_no_metric(tmp_path):
    source = data_dir("lpips")
    features, lin = FILES
    (tmp_path / lin).write_bytes((source / lin).read_bytes())
    (tmp_path / features).write_bytes((source / features).read_bytes()[:100_000])
    lpips, reason = open_lpips(tmp_path)
    assert lpips is None and "cannot be used" in reason
    (tmp_path / features).write_bytes((source / features).read_bytes())
    np.savez(tmp_path / lin, lin0=np.ones(64, np.float32))
    lpips, reason = open_lpips(tmp_path)
    assert lpips is None and "[64]" in reason and "[64, 192, 384, 256, 256]" in reason


def test_what_the_command_lacks_is_one_line(tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "lpips", None)
        needs = "needs lpips: pip install 'freshfield[edge,lpips]'"
        assert needs in refusal(capsys, edge_server, "fetch-lpips", "--out", tmp_path)
    (tmp_path / "lpips.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "lpips", raising=False)
    said = refusal(capsys, edge_server, "fetch-lpips", "--out", tmp_path)
    assert "nms does not exist): install it from the index of torch" in said


def test_the_command_says_where_it_wrote_what_it_fetched(tmp_path, monkeypatch, capsys):
    published = [dict(np.load(data_dir("lpips") / name)) for name in FILES]
    features = {name.removeprefix("features."): array for name, array in published[0].items()}
    lins = {f"{name}.model.1.weight": array.reshape(1, -1, 1, 1) for name, array in published[1].items()}
    refused(FetchError, "cannot be used", convert, {k: v for k, v in features.items() if k != "3.bias"}, lins, tmp_path)
    monkeypatch.setattr(fetch_lpips_command, "_fetch", lambda: (features, lins))
    assert edge_server(["fetch-lpips", "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().out.split() == [str(tmp_path / name) for name in FILES]
    for name, arrays in zip(FILES, published):
        np.testing.assert_equal(dict(np.load(tmp_path / name)), arrays)
