"""Scores of held-out views: against which capture, and on its thread within its share of the machine."""

from __future__ import annotations

import re
import time
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fidelity.fidelity_constants import SO_FAR_FRAMES
from edge_server.fidelity.psnr import PSNR_CEILING_DB
from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fields import Rendering, View
from edge_server.live import live_constants as tuned
from edge_server.live.live_constants import MOST_PENDING
from edge_server.live.scoring import scoring_thread
from edge_server.live.scoring.held_out import HeldOutCamera
from edge_server.live.scoring.scoring_thread import ScoringThread
from edge_server.live.state import Publication
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose

MS = 1_000_000
SIDE = 48
LENS = Pinhole.from_fov(SIDE, SIDE, 60.0)
HERE = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


def truth_at(ms):
    """A square that moves 1 pixel in 20 ms over a textured, static wall."""
    image = 0.3 + 0.2 * np.random.default_rng(0).random((SIDE, SIDE, 3))
    column = round(ms / 20) % (SIDE - 8)
    image[10:18, column : column + 8] = 0.95
    return np.round(image * 255).astype(np.uint8)


def frame(ms, image=None, x_m=0.0, camera="h"):
    image = truth_at(ms) if image is None else image
    pose = replace(HERE, translation_m=(x_m, 0.0, 0.0))
    return Frame(camera, "s", ms, ms * MS, pose, LENS, "png", payload.encode(image, "png"))


def camera(until_ms):
    """A held-out camera, with frames of every 40 ms until then."""
    made = HeldOutCamera("h", Scorer())
    feed(made, until_ms)
    return made


def feed(held_out, until_ms, start_ms=0):
    return [found for ms in range(start_ms, until_ms + 1, 40) for found in held_out.take(frame(ms))]


class Shows:
    """A snapshot that shows one image (H, W, 3) in [0, 1], and notes where it was rendered."""

    def __init__(self, image):
        self.image, self.poses = np.asarray(image, np.float32), []

    def at(self, present_ns):
        return brightness(present_ns)

    def render(self, camera_to_world, intrinsics):
        self.poses.append(camera_to_world[0, 3])
        return Rendering(self.image, self.image[..., 0], self.image[..., 0])


def shows(ms):
    return Shows(truth_at(ms) / 255)


def brightness(at_ns):
    """A snapshot that renders its instant, in seconds, as a brightness."""
    return Shows(np.full((SIDE, SIDE, 3), at_ns / 1e9))


def publication(ms):
    return Publication(ms, ms / 1e3, ms * MS, None, ("a",), (1.0,), 1.0, 1.0)


def bright(ms, x_m=0.0):
    """A frame as bright as the instant in seconds."""
    return frame(ms, np.full((SIDE, SIDE, 3), round(0.255 * ms), np.uint8), x_m, "cam00")


@pytest.mark.parametrize("present_ms, gap_ms", [(430, 10.0), (410, -10.0)])
def test_a_publication_is_scored_against_the_capture_nearest_to_the_present(present_ms, gap_ms):
    held_out = camera(400)
    assert held_out.publish(publication(present_ms), shows(present_ms + gap_ms)) == []  # none at or after it yet
    (found,) = held_out.take(frame(440))
    score = found.score
    assert score.psnr_db == PSNR_CEILING_DB and score.psnr_moving_db == PSNR_CEILING_DB
    assert (score.camera, score.truth_gap_ms, score.published_ns) == ("h", gap_ms, present_ms * MS)
    assert found.truth.taken_ns == round((present_ms + gap_ms) * MS)
    assert found.publication.number == present_ms and found.rendered.shape == (SIDE, SIDE, 3)


def test_without_a_capture_within_half_a_period_there_is_no_score_and_nothing_piles_up():
    held_out = camera(400)
    held_out.publish(publication(500), shows(0))
    assert held_out.take(frame(600)) == []
    assert held_out.publish(publication(600), shows(600)), "the one that follows has one"
    held_out, shown = camera(400), shows(0)
    for k in range(100):
        held_out.publish(publication(401 + k), shown)
    assert len(shown.poses) == MOST_PENDING


def test_the_history_stays_short_and_nothing_is_decoded_that_no_score_needs(monkeypatch):
    decoded, decode = [], payload.decode
    monkeypatch.setattr(payload, "decode", lambda *of: decoded.append(1) or decode(*of))
    held_out = camera(60_000)
    assert len(held_out.truths) == 33 and not decoded  # 1.3 s
    held_out.publish(publication(59_960), shows(0))
    assert 2 <= len(decoded) <= 5


def test_a_clock_that_jumps_back_starts_a_new_history():
    held_out = camera(4000)
    feed(held_out, 400)
    assert [truth.taken_ns // MS for truth in held_out.truths] == list(range(0, 401, 40))
    (found,) = held_out.publish(publication(390), shows(400))
    assert found.score.psnr_db == PSNR_CEILING_DB and found.score.truth_gap_ms == 10.0


@pytest.mark.parametrize("noisy, most", [(False, 1.0), (True, 0.1)])
def test_the_noise_of_real_video_is_not_motion(noisy, most):
    rng = np.random.default_rng(8)
    wall = 0.3 + 0.4 * rng.random((SIDE, SIDE, 3))
    held_out = HeldOutCamera("h", Scorer(), noisy)
    for ms in range(0, 801, 40):
        held_out.take(frame(ms, np.round(np.clip(wall + rng.normal(0, 0.02, wall.shape), 0, 1) * 255).astype(np.uint8)))
        found = held_out.publish(publication(ms - 5), Shows(wall))
    assert most - 0.5 <= found[0].score.moving_share <= most


def test_a_camera_that_moves_is_rendered_where_it_was_when_the_truth_was_taken_and_one_snapshot_waits():
    held_out = HeldOutCamera("h", Scorer())
    for ms in range(0, 401, 40):
        held_out.take(frame(ms, x_m=ms / 1e3))
    shown, later = shows(440), shows(440)
    held_out.publish(publication(430), shown)
    held_out.publish(publication(435), later)
    assert shown.poses == []  # its place is not known before its truth has come
    (found,) = held_out.take(frame(440, x_m=0.44))
    assert shown.poses == [0.44] and later.poses == [] and found.score.psnr_db == PSNR_CEILING_DB


def test_one_damaged_frame_costs_its_own_publication_and_is_decoded_once(monkeypatch):
    held_out = camera(400)
    held_out.publish(publication(440), shows(440))
    held_out.publish(publication(520), shows(520))
    torn = replace(frame(440), payload=b"torn")
    found = [*held_out.take(torn), *feed(held_out, 800, 480)]
    assert [each.publication.number for each in found] == [520]
    assert held_out.undecodable == 1 and torn not in [truth.frame for truth in held_out.truths]


def test_a_poisoned_rendering_goes_unscored_and_the_log_says_where(caplog):
    poisoned = truth_at(0) / 255
    poisoned[3, 4, 1] = np.nan
    held_out = camera(400)
    assert held_out.publish(publication(390), Shows(poisoned)) == []
    assert re.search(r"rendering: 1 of 6912 .* row 3, column 4, channel 1", caplog.text)
    assert len(held_out.publish(publication(391), shows(0))) == 1, "the next is scored"


def _run(
    publications: list[int], frames: range, scored: list[Publication] | None = None, scorer: Scorer | None = None
) -> list[tuple[Score, Publication]]:
    """Scores of what was shown, of publications and held-out frames at given instants in ms. scored: takes
    publications with their scores."""
    shown, taken = [], [] if scored is None else scored
    thread = ScoringThread(["cam00"], scorer or Scorer(), lambda of, *_: taken.append(of), lambda *of: shown.append(of))
    thread.load()
    thread.start()
    for ms, of_frame in sorted([(ms, False) for ms in publications] + [(ms, True) for ms in frames]):
        if of_frame:
            thread.held_out_frame(bright(ms))
        else:
            thread.published(publication(ms), brightness(ms * MS), [])
        time.sleep(0.002)  # nothing may fall out of its short inbox
    thread.stop()
    return shown


def test_the_newest_publication_is_shown_carried_on_to_the_capture(monkeypatch: Any) -> None:
    monkeypatch.setattr(tuned, "SHOWN_SHARE", 1e-9)
    shown = _run([100, 350, 600], range(0, 900, 10))
    assert len(shown) > 1
    for score, of in shown:
        assert of.published_ns == max(ms * MS for ms in (100, 350, 600) if ms * MS <= score.published_ns)
        # Rendered at the instant of the capture: equal but for the rounding to 8 bits.
        assert score.psnr_db > 50.0 and score.truth_gap_ms == 0.0
    gaps = np.diff([score.published_ns for score, _ in shown]) / MS
    assert len(set(gaps.tolist())) == len(gaps), "random instants"


def _thread(*cameras: str) -> ScoringThread:
    """Which tells its scores to nobody, and is not started."""
    return ScoringThread(cameras or ("cam00",), Scorer(), lambda *_: None, lambda *_: None)


def test_a_thread_that_falls_behind_keeps_no_snapshots() -> None:
    """Each is as large as the field."""
    alive, thread = weakref.WeakSet[Shows](), _thread()
    for k in range(100):
        alive.add(snapshot := brightness(k * 20 * MS))
        thread.published(publication(k * 20), snapshot, [])
    del snapshot
    assert len(alive) == tuned.WAITING_PUBLICATIONS


def test_snapshots_replaced_before_the_next_scored_capture_are_dropped() -> None:
    thread = _thread()
    thread._next_shown_ns["cam00"] = 500 * MS
    for ms in range(20, 600, 20):
        thread._score_later(publication(ms), brightness(ms * MS), [])
    assert [p.published_ns // MS for p, _ in thread._recent] == [500, 520, 540, 560, 580]


def test_a_silent_held_out_camera_keeps_no_snapshots(monkeypatch: Any) -> None:
    monkeypatch.setattr(tuned, "SILENT_CAMERA_NS", 100 * MS)
    thread = _thread("cam00", "cam01")
    for ms in range(20, 260, 20):
        thread._held_out["cam00"].take(bright(ms))
        thread._score_later(publication(ms), brightness(ms * MS), [])
    assert len(thread._recent) == 1


def test_what_is_shown_is_scored_as_often_as_its_share_affords_and_before_publications(monkeypatch: Any) -> None:
    monkeypatch.setattr(tuned, "SHOWN_SHARE", 0.5)
    scored: list[Publication] = []
    shown = _run([100, 350], range(0, 900, 10), scored)
    assert len(shown) > 10 and len(scored) == 2
    assert all((score.ssim is not None) == (k % 4 == 0) for k, (score, _) in enumerate(shown))
    monkeypatch.setattr(tuned, "RESERVE_S", tuned.ALLOWANCE_S)
    scored.clear()
    assert len(_run([100, 350], range(0, 900, 10), scored)) > 10 and not scored


def test_time_that_was_not_used_is_no_credit_beyond_the_allowance(monkeypatch: Any) -> None:
    now_s, used_s = [0.0], [0.0]
    monkeypatch.setattr(scoring_thread.time, "monotonic", lambda: now_s[0])
    monkeypatch.setattr(scoring_thread.time, "thread_time", lambda: used_s[0])
    thread = _thread()
    now_s[0] = 1000.0
    assert thread._affordable()
    used_s[0] = 1.1
    assert not thread._affordable()
    now_s[0] += 0.1 / (0.03 * scoring_thread.usable_cores()) + 1.0
    assert thread._affordable() and not thread._affordable(0.1)


def test_a_metric_that_cannot_be_loaded_costs_its_own_scores_alone(caplog: pytest.LogCaptureFixture) -> None:
    def broken(a: Any, b: Any, mask: Any) -> float:
        raise RuntimeError("no weights")

    broken.minimum_side = SIDE + 1  # larger than the frames: of them it is not asked
    assert _run([100], range(0, 600, 10), scorer=Scorer(broken))
    assert "a metric could not be loaded" in caplog.text


def test_where_nothing_is_held_out_the_mean_color_is_that_of_the_views() -> None:
    told: list[tuple[Publication, bool]] = []
    thread = ScoringThread([], Scorer(), lambda of, _, final: told.append((of, final)), lambda *_: None)
    images = [np.full((SIDE, SIDE, 3), level, np.uint8) for level in (102, 153)]  # 0.4 and 0.6: 0.1 from their mean
    views = [View(f"cam{k}", image, np.eye(4), LENS) for k, image in enumerate(images)]
    thread._score_selected(publication(500), brightness(500 * MS), views)
    ((scored, final),) = told
    assert final and thread.baselines.mean.nearest_view_db is None
    np.testing.assert_allclose([scored.psnr_db, thread.baselines.mean.mean_color_db], 20.0, atol=1e-3)
    clear, shown = np.zeros((SIDE, SIDE, 4), np.uint8), []  # transparent: as bright as what lies behind
    white = ScoringThread([], Scorer(background=(1.0, 1.0, 1.0)), lambda *of: shown.append(of[1].truth), print)
    white._score_selected(publication(500), brightness(500 * MS), [replace(views[0], image=clear), views[0]])
    np.testing.assert_allclose(white.baselines.mean.mean_color_db, -20 * np.log10(0.3), atol=1e-3)
    assert shown[0].shape == (SIDE, SIDE, 3) and (shown[0] == 255).all()


def test_of_a_held_out_camera_that_moves_the_newest_frame_and_all_so_far_are_told_apart() -> None:
    """The field knows how bright it is at half a second, and shows that everywhere."""
    thread = _thread()
    for ms in range(0, 500, 5):
        thread._held_out["cam00"].take(bright(ms, x_m=0.002 * ms))
    thread._held_out["cam00"].take(replace(bright(500), payload=b"damaged"))
    thread._recent.append((publication(0), brightness(500 * MS)))
    thread._look_back()  # the newest is damaged
    thread._look_back()
    assert thread.so_far is not None and thread.so_far.frames == 3  # two in turn, and the newest
    thread._look_back(whole=True)
    found = thread.so_far
    # Spread over the run, the damaged one forgotten.
    assert SO_FAR_FRAMES // 2 <= found.frames <= SO_FAR_FRAMES and not found.refined
    assert found.now_psnr_db > 35.0 and 8.0 < found.all_psnr_db < 20.0
    words = f"now {found.now_psnr_db:.2f} dB, all {found.frames} frames so far {found.all_psnr_db:.2f} dB"
    assert found.words() == words
