"""The scoring thread: what was shown when a held-out frame was taken, within its share of the machine."""

from __future__ import annotations

import time
import weakref
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fidelity.so_far import MOST
from edge_server.fields import Rendering, View
from edge_server.live import settings
from edge_server.live.scoring import scoring_thread
from edge_server.live.scoring.scoring_thread import ScoringThread
from edge_server.live.state import Publication
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pinhole, Pose

LENS = Pinhole.from_fov(32, 32, 60.0)
MS = 1_000_000


class Brightness:
    """A snapshot that renders its instant, in seconds, as a brightness."""

    def __init__(self, at_ns: int) -> None:
        self.at_ns = at_ns

    def at(self, present_ns: int) -> Brightness:
        return Brightness(present_ns)

    def render(self, camera_to_world: Any, intrinsics: Pinhole) -> Rendering:
        flat = np.ones((intrinsics.height, intrinsics.width), np.float32)
        color = np.repeat(flat[..., None] * np.float32(self.at_ns / 1e9), 3, axis=-1)
        return Rendering(color, flat, flat)


def _frame(sequence: int, at_ns: int) -> Frame:
    image = np.full((32, 32, 3), round(255 * at_ns / 1e9), np.uint8)
    pose = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    return Frame("cam00", "s", sequence, at_ns, pose, LENS, "png", payload.encode(image, "png"))


def _publication(number: int, at_ns: int) -> Publication:
    return Publication(number, at_ns / 1e9, at_ns, None, ("cam01",), (1.0,), 1.0, 1.0)


def _run(
    publications: list[int], frames: list[int], scored: list[Publication] | None = None, scorer: Scorer | None = None
) -> list[tuple[Score, Publication]]:
    """Scores of what was shown, of publications and held-out frames at given instants in ns. scored: takes
    publications with their scores."""
    shown, taken = [], [] if scored is None else scored
    thread = ScoringThread(["cam00"], scorer or Scorer(), lambda of, *_: taken.append(of), lambda *of: shown.append(of))
    events = [(at, 0, n) for n, at in enumerate(publications)] + [(at, 1, n) for n, at in enumerate(frames)]
    thread.load()
    thread.start()
    for at_ns, kind, number in sorted(events):
        if kind:
            thread.held_out_frame(_frame(number, at_ns))
        else:
            thread.published(_publication(number, at_ns), Brightness(at_ns), [])
        time.sleep(0.002)  # nothing may fall out of its short inbox
    thread.stop()
    return shown


def test_the_newest_publication_is_shown_carried_on_to_the_capture(monkeypatch: Any) -> None:
    monkeypatch.setattr(settings, "SHOWN_SHARE", 1e-9)
    shown = _run([100 * MS, 350 * MS, 600 * MS], [k * 10 * MS for k in range(90)])
    assert len(shown) > 1
    for score, publication in shown:
        newest = max(at for at in (100 * MS, 350 * MS, 600 * MS) if at <= score.published_ns)
        assert publication.published_ns == newest
        # Rendered at the instant of the capture: equal but for the rounding to 8 bits.
        assert score.psnr_db > 50.0 and score.truth_gap_ms == 0.0
    gaps = np.diff([score.published_ns for score, _ in shown]) / MS
    assert len(set(gaps.tolist())) == len(gaps), "random instants"


def _thread(*cameras: str) -> ScoringThread:
    """Which tells its scores to nobody, and is not started."""
    return ScoringThread(cameras or ("cam00",), Scorer(), lambda *_: None, lambda *_: None)


def test_a_thread_that_falls_behind_keeps_no_snapshots() -> None:
    """Each is as large as the field."""
    alive, thread = weakref.WeakSet[Brightness](), _thread()
    for k in range(100):
        alive.add(snapshot := Brightness(k * 20 * MS))
        thread.published(_publication(k, snapshot.at_ns), snapshot, [])
    del snapshot
    assert len(alive) == settings.WAITING_PUBLICATIONS


def test_snapshots_replaced_before_the_next_scored_capture_are_dropped() -> None:
    thread = _thread()
    thread._next_shown_ns["cam00"] = 500 * MS
    for k in range(1, 30):
        thread._score_later(_publication(k, k * 20 * MS), Brightness(k * 20 * MS), [])
    assert [p.published_ns // MS for p, _ in thread._recent] == [500, 520, 540, 560, 580]


def test_a_silent_held_out_camera_keeps_no_snapshots(monkeypatch: Any) -> None:
    monkeypatch.setattr(settings, "SILENT_CAMERA_NS", 100 * MS)
    thread = _thread("cam00", "cam01")
    for k in range(1, 13):
        thread._held_out["cam00"].take(_frame(k, k * 20 * MS))
        thread._score_later(_publication(k, k * 20 * MS), Brightness(k * 20 * MS), [])
    assert len(thread._recent) == 1


def test_what_is_shown_is_scored_as_often_as_its_share_affords_and_before_publications(monkeypatch: Any) -> None:
    monkeypatch.setattr(settings, "SHOWN_SHARE", 0.5)
    scored: list[Publication] = []
    frames = [k * 10 * MS for k in range(90)]
    shown = _run([100 * MS, 350 * MS], frames, scored)
    assert len(shown) > 10 and len(scored) == 2
    assert all((score.ssim is not None) == (k % 4 == 0) for k, (score, _) in enumerate(shown))
    monkeypatch.setattr(settings, "RESERVE_S", settings.ALLOWANCE_S)
    scored.clear()
    assert len(_run([100 * MS, 350 * MS], frames, scored)) > 10 and not scored


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

    broken.minimum_side = 48  # larger than the frames: of them it is not asked
    assert _run([100 * MS], [k * 10 * MS for k in range(60)], scorer=Scorer(broken))
    assert "a metric could not be loaded" in caplog.text


def test_where_nothing_is_held_out_the_mean_color_is_that_of_the_views() -> None:
    told: list[tuple[Publication, bool]] = []
    thread = ScoringThread([], Scorer(), lambda of, _, final: told.append((of, final)), lambda *_: None)
    images = [np.full((32, 32, 3), level, np.uint8) for level in (102, 153)]  # 0.4 and 0.6: 0.1 from their mean
    views = [View(f"cam{k}", image, np.eye(4), LENS) for k, image in enumerate(images)]
    thread._score_selected(_publication(3, 500 * MS), Brightness(500 * MS), views)
    ((scored, final),) = told
    assert final and thread.baselines.mean.nearest_view_db is None
    np.testing.assert_allclose([scored.psnr_db, thread.baselines.mean.mean_color_db], 20.0, atol=1e-3)


def test_of_a_held_out_camera_that_moves_the_newest_frame_and_all_so_far_are_told_apart() -> None:
    """The field knows how bright it is at half a second, and shows that everywhere."""
    thread = _thread()
    for k in range(100):
        pose = Pose((1.0, 0.0, 0.0, 0.0), (0.01 * k, 0.0, 0.0))
        thread._held_out["cam00"].take(replace(_frame(k, 5 * k * MS), pose=pose))
    thread._held_out["cam00"].take(replace(_frame(100, 500 * MS), payload=b"damaged"))
    thread._recent.append((_publication(0, 0), Brightness(500 * MS)))
    thread._look_back()  # the newest is damaged
    thread._look_back()
    assert thread.so_far is not None and thread.so_far.frames == 3  # two in turn, and the newest
    thread._look_back(whole=True)
    found = thread.so_far
    assert MOST // 2 <= found.frames <= MOST and not found.refined  # spread over the run, the damaged one forgotten
    assert found.now_psnr_db > 35.0 and 8.0 < found.all_psnr_db < 20.0
    words = f"now {found.now_psnr_db:.2f} dB, all {found.frames} frames so far {found.all_psnr_db:.2f} dB"
    assert found.words() == words
