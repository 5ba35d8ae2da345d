from __future__ import annotations

import re

import numpy as np
import pytest

from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.psnr import PSNR_CEILING_DB
from edge_server.fidelity.scorer import MAX_PENDING, Scorer, mean_score
from tests.conftest import data_dir

MS = 1_000_000


def truth_at(ms, size=48):
    """A square that moves 1 pixel in 20 ms over a textured, static wall."""
    rng = np.random.default_rng(0)
    image = 0.3 + 0.2 * rng.random((size, size, 3))
    column = round(ms / 20) % (size - 8)
    image[10:18, column : column + 8] = 0.95
    return np.round(image * 255).astype(np.uint8)


def feed(scorer, until_ms, start_ms=0, period_ms=40):
    done = []
    for ms in range(start_ms, until_ms + 1, period_ms):
        done += scorer.held_out("h", truth_at(ms), ms * MS)
    return done


def test_a_rendering_is_scored_against_the_capture_nearest_to_the_present():
    scorer = Scorer()
    feed(scorer, 400)
    rendering = (truth_at(440) / 255).astype(np.float32)
    assert scorer.publish("h", rendering, 430 * MS) == []  # its truth has not arrived
    (score,) = scorer.held_out("h", truth_at(440), 440 * MS)
    assert score.psnr_db == PSNR_CEILING_DB and score.psnr_moving_db == PSNR_CEILING_DB
    assert score.ssim == pytest.approx(1.0) and score.lpips is None
    assert score.truth_gap_ms == 10.0 and score.on == "held-out" and score.camera == "h"


def test_the_earlier_of_two_captures_wins_when_it_is_nearer():
    scorer = Scorer()
    feed(scorer, 400)
    scorer.publish("h", (truth_at(400) / 255).astype(np.float32), 410 * MS)
    (score,) = scorer.held_out("h", truth_at(440), 440 * MS)
    assert score.truth_gap_ms == -10.0 and score.psnr_db == PSNR_CEILING_DB


def test_a_stale_rendering_loses_where_the_scene_moved_and_only_there():
    scorer = Scorer()
    feed(scorer, 800)
    (score,) = scorer.publish("h", (truth_at(600) / 255).astype(np.float32), 795 * MS)
    assert score.psnr_moving_db < score.psnr_db - 6.0
    assert 0.02 < score.moving_share < 0.2


def test_nothing_moves_in_a_static_scene():
    scorer = Scorer()
    for ms in range(0, 400, 40):
        scorer.held_out("h", truth_at(0), ms * MS)
    (score,) = scorer.publish("h", np.zeros((48, 48, 3), np.float32), 350 * MS)
    assert score.psnr_moving_db is None and score.moving_share == 0.0


def test_a_pair_of_frames_tells_the_noise_once_however_often_it_is_scored():
    scorer = Scorer(noisy_truth=True)
    for ms in range(0, 200, 40):
        scorer.held_out("h", truth_at(ms), ms * MS)
    for _ in range(5):
        assert scorer.publish("h", np.zeros((48, 48, 3), np.float32), 150 * MS)
    assert len(scorer._camera("h").noise.pairs) == 1


def test_no_capture_within_half_a_period_means_no_score():
    scorer = Scorer(period_ms=40)
    feed(scorer, 400)
    scorer.publish("h", np.zeros((48, 48, 3), np.float32), 500 * MS)
    assert scorer.held_out("h", truth_at(600), 600 * MS) == []
    assert scorer.unscored == 1


def test_renderings_that_never_find_a_truth_do_not_pile_up():
    scorer = Scorer(period_ms=40)
    for i in range(100):
        scorer.publish("h", np.zeros((48, 48, 3), np.float32), i * MS)
    assert scorer.unscored == 100 - MAX_PENDING


def test_a_slow_publication_still_finds_its_truth_and_its_motion():
    scorer = Scorer(period_ms=40)
    feed(scorer, 200)
    assert scorer.publish("h", (truth_at(240) / 255).astype(np.float32), 240 * MS) == []
    scores = feed(scorer, 4000, 240)
    assert [s.truth_gap_ms for s in scores] == [0.0] and scores[0].psnr_moving_db == PSNR_CEILING_DB


def test_the_history_stays_short():
    decoded = []

    def lazily(ms):
        def load():
            decoded.append(ms)
            return truth_at(ms)

        return load

    scorer = Scorer()
    for ms in range(0, 60_000, 40):
        scorer.held_out("h", lazily(ms), ms * MS)
    assert len(scorer._cameras["h"].frames) < 40
    assert decoded == []  # nothing is decoded that no score needs
    scorer.publish("h", np.zeros((48, 48, 3), np.float32), 59_960 * MS)
    assert 2 <= len(decoded) <= 5


def test_a_clock_that_jumps_back_starts_a_new_history():
    scorer = Scorer(period_ms=40)
    feed(scorer, 4000)
    feed(scorer, 400)
    (score,) = scorer.publish("h", (truth_at(400) / 255).astype(np.float32), 390 * MS)
    assert score.psnr_db == PSNR_CEILING_DB and score.truth_gap_ms == 10.0


def test_the_noise_of_real_video_is_not_motion():
    rng = np.random.default_rng(8)
    wall = 0.3 + 0.4 * rng.random((48, 48, 3))

    def noisy(_):
        return np.round(np.clip(wall + rng.normal(0, 0.02, wall.shape), 0, 1) * 255).astype(np.uint8)

    shares = {}
    for noisy_truth in (False, True):
        scorer = Scorer(noisy_truth=noisy_truth, period_ms=40)
        for ms in range(0, 801, 40):
            scorer.held_out("h", noisy(ms), ms * MS)
            if ms > 400:
                (score,) = scorer.publish("h", wall.astype(np.float32), (ms - 5) * MS)
        shares[noisy_truth] = score.moving_share
    assert shares[False] > 0.5 and shares[True] < 0.1


def test_selected_views_are_averaged_and_say_so():
    gray = np.full((32, 32, 3), 128, np.uint8)
    off = (gray / 255 + 0.1).astype(np.float32)
    score = Scorer().score_selected([("a", gray / 255, gray), ("b", off, gray)], 5 * MS)
    assert score.on == "selected" and score.truth_gap_ms is None and score.camera == "a,b"
    assert score.psnr_db == pytest.approx((PSNR_CEILING_DB + 20.0) / 2, abs=1e-4)
    assert score.psnr_moving_db is None
    assert Scorer().score_selected([], 0) is None


def test_lpips_is_scored_where_the_image_is_large_enough():
    lpips, _ = open_lpips(data_dir("lpips"))
    scorer = Scorer(lpips=lpips)
    truth = truth_at(0)
    assert scorer.score("h", truth / 255, 0, truth, 0).lpips == 0.0
    small = scorer.score("h", truth[:24, :24] / 255, 0, truth[:24, :24], 0)
    assert small.lpips is None and small.ssim == pytest.approx(1.0)


def test_a_poisoned_rendering_goes_unscored_and_the_log_says_where(caplog):
    rendering = np.full((48, 48, 3), 0.5, np.float32)
    rendering[3, 4, 1] = np.nan
    scorer = Scorer()
    feed(scorer, 400)
    assert scorer.publish("h", rendering, 390 * MS) == []
    assert scorer.unscored == 1
    assert re.search(r"rendering: 1 of 6912 .* row 3, column 4, channel 1", caplog.text)
    # The poisoned one is gone; the next is scored.
    assert len(scorer.publish("h", np.full((48, 48, 3), 0.5, np.float32), 391 * MS)) == 1


def test_the_mean_over_cameras_skips_what_a_camera_lacks():
    gray = np.full((16, 16, 3), 0.5)
    scorer = Scorer()
    a = scorer.score("a", gray, 0, gray + 0.1, 0, [gray])
    b = scorer.score("b", gray[:8], 0, gray[:8] + 0.1, 0)
    mean = mean_score([a, b])
    assert mean.ssim == a.ssim and b.ssim is None and mean.psnr_moving_db == pytest.approx(20.0)
    assert mean.camera == "a,b"


def test_a_held_out_camera_that_moves_is_rendered_where_it_was_when_the_truth_was_taken():
    asked = []

    def render(generated_ns):
        asked.append(generated_ns)
        return (truth_at(440) / 255).astype(np.float32)

    scorer = Scorer()
    feed(scorer, 400)
    scorer.publish("h", render, 430 * MS)
    assert asked == []  # nothing is rendered before its truth has come
    (score,) = scorer.held_out("h", truth_at(440), 440 * MS)
    assert asked == [440 * MS] and score.psnr_db == PSNR_CEILING_DB


def test_frames_from_another_viewpoint_tell_nothing_about_motion_or_noise():
    for viewpoints, moves in (("same", True), ("new", False)):
        scorer = Scorer(noisy_truth=True)
        for ms in range(0, 801, 40):
            pose = 0 if viewpoints == "same" else ms
            scorer.held_out("h", truth_at(ms), ms * MS, pose)
        (score,) = scorer.publish("h", np.zeros((48, 48, 3), np.float32), 790 * MS)
        assert (score.psnr_moving_db is not None) == moves
        assert bool(scorer._cameras["h"].noise.pairs) == moves


def test_one_damaged_held_out_frame_costs_only_its_own_publication():
    scorer = Scorer(period_ms=30.0)
    calls = []

    def damaged():
        calls.append(1)
        raise ValueError("the jpeg data is damaged")

    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (32, 32, 3), np.uint8)
    rendering = image.astype(np.float32) / 255
    period = 30_000_000
    scorer.held_out("cam00", image, 0)
    scorer.publish("cam00", rendering, period)
    scorer.publish("cam00", rendering, 4 * period)
    scores = scorer.held_out("cam00", damaged, period)
    for k in range(2, 7):
        scores += scorer.held_out("cam00", image, k * period)
    assert [s.published_ns for s in scores] == [4 * period]
    assert scorer.unscored == 1
    assert len(calls) == 1  # it has left the history: nobody decodes it again


def test_what_was_shown_at_the_newest_truth_is_scored_once_the_period_is_known():
    scorer = Scorer()
    assert scorer.newest("h", lambda taken_ns: truth_at(0)) is None
    feed(scorer, 0)
    assert scorer.period_ms("h") is None and scorer.newest("h", lambda taken_ns: truth_at(0)) is None
    feed(scorer, 40, start_ms=40)
    assert scorer.period_ms("h") == 40.0
    score = scorer.newest("h", lambda taken_ns: truth_at(taken_ns // MS) / 255)
    assert score is not None and score.psnr_db == PSNR_CEILING_DB
    with pytest.raises(ValueError, match="48 x 24 but the truth is 48 x 48"):
        scorer.newest("h", lambda taken_ns: truth_at(40)[:24])
