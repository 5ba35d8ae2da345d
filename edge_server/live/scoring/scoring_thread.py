"""Scores publications, and what is shown between them, on a separate thread, so that neither ingest nor the field
waits for it.

Each held-out camera compares publications with its captures (``held_out``). If scoring falls behind, publications
stay unscored (nulls in the series) and nothing queues up. A snapshot is as large as the field, so only those are kept
that a future capture may need. The thread's own computing, without the rendering in the field's workers, is a bounded
share of the machine's.

What was shown is scored at random captures of each held-out camera: the newest publication at that instant,
extrapolated to it (``Snapshot.at``), as the page renders it for a visitor who moves.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from edge_server.fidelity.baselines import BaselineMean, baseline, mean_color_db
from edge_server.fidelity.images import opaque, to_bytes
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fidelity.so_far import FrameScore, so_far
from edge_server.fields import Snapshot, View
from edge_server.live import live_constants as tuned
from edge_server.live.scoring.held_out import HeldOutCamera, Scored, Truth
from edge_server.live.state import Comparison, Publication
from edge_server.run_records import Baseline, SoFarScores
from freshfield.frame import Frame
from freshfield.machine_load import usable_cores
from freshfield.scenario import seed_sequence

log = logging.getLogger(__name__)


class ScoringThread:
    """The thread that owns the scorer.

    held_out: ids of the held-out cameras; if there are none, the selected views are scored.
    on_scored(publication with scores, comparison or None, final): called on this thread. final: the scores of
    all held-out cameras are in.
    on_shown(score, publication): ``score`` rates what was shown at ``score.published_ns``, ``publication``
    extrapolated to that instant. Called on this thread.
    seed: determines the random instants.
    noisy: held-out frames are real video (``HeldOutCamera``).
    """

    def __init__(
        self,
        held_out: Sequence[str],
        scorer: Scorer,
        on_scored: Callable[[Publication, Comparison | None, bool], None],
        on_shown: Callable[[Score, Publication], None],
        seed: int = 0,
        noisy: bool = False,
    ) -> None:
        self._held_out = {camera: HeldOutCamera(camera, scorer, noisy) for camera in held_out}
        self._scorer = scorer
        self._on_scored = on_scored
        self._on_shown = on_shown
        self._rng = np.random.default_rng(seed_sequence(seed, "shown"))
        self._recent: deque[tuple[Publication, Snapshot]] = deque(maxlen=tuned.MOST_SNAPSHOTS)
        self._left_out_ns = 0  # instant of the newest publication that this thread skipped
        self._next_shown_ns = dict.fromkeys(self._held_out, 0)
        self._shown_count, self._shown_cost_s = 0, np.inf  # cost of the last score of what is shown, CPU s
        self._allowance_s = tuned.FIRST_ALLOWANCE_S
        self._asked_s, self._used_s = time.monotonic(), 0.0
        self._new_frames: deque[Frame] = deque(maxlen=tuned.WAITING_FRAMES)
        self._new_publications: deque[tuple[Publication, Snapshot, list[View]]] = deque()
        self._wake = threading.Condition()
        self._ending = False
        self._open: dict[int, list[Score]] = {}  # publications of which some cameras are still to be scored
        self._views: list[View] = []
        self._selected_scored = 0  # publications scored on the views learned from
        self.baselines = BaselineMean()
        self.so_far: SoFarScores | None = None
        """Scores of moving held-out cameras: now, and all frames so far. At the end of a run all of these are rendered
        from the last field; before, as many as this thread has time for."""
        self._frame_scores: dict[Truth, FrameScore] = {}
        self._looked_at = 0  # frames of ``so_far`` scored so far
        self._ends_s = np.inf  # when ``stop`` stops waiting
        self._thread = threading.Thread(target=self._main, name="scoring", daemon=True)

    def load(self) -> None:
        """Load what the metrics need: two seconds for LPIPS, during which Python runs little else."""
        try:
            self._scorer.warm_up()
        except Exception:  # it costs scores, not the server
            log.exception("a metric could not be loaded")

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Score what has arrived, for ``timeout_s`` at most, and end."""
        with self._wake:
            self._ending, self._ends_s = True, time.monotonic() + timeout_s
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    @property
    def undecodable(self) -> int:
        """Number of damaged held-out frames."""
        return sum(camera.undecodable for camera in self._held_out.values())

    def held_out_frame(self, frame: Frame) -> None:
        """A held-out frame has arrived; it is decoded when it is compared with. Never blocks."""
        with self._wake:
            self._new_frames.append(frame)
            self._wake.notify()

    def published(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        """An update was published. Never blocks."""
        with self._wake:
            self._new_publications.append((publication, renderer, views))
            if len(self._new_publications) > tuned.WAITING_PUBLICATIONS:
                left_out, _, _ = self._new_publications.popleft()
                self._left_out_ns = left_out.published_ns
            self._wake.notify()

    def _main(self) -> None:
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), tuned.SCORING_NICE)
        except (OSError, AttributeError):
            log.debug("thread priority cannot be lowered here")
        self._asked_s, self._used_s = time.monotonic(), time.thread_time()
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._new_frames or self._new_publications or self._ending)
                if self._ending and self._new_publications and self._moving():
                    # Scores of all frames so far from the last field matter more than the publications that wait.
                    self._recent.append(self._new_publications[-1][:2])
                    self._new_publications.clear()
                published = self._new_publications.popleft() if self._new_publications else None
                frame = self._new_frames.popleft() if published is None and self._new_frames else None
            if published is None and frame is None:
                self._look_back(whole=True)
                return
            try:
                if frame is not None:
                    self._finish(self._held_out[frame.camera].take(frame))
                    self._score_shown(frame)
                elif published is not None:
                    (self._score_later if self._held_out else self._score_selected)(*published)
            except Exception:  # one bad image must not end all scoring; it is logged with its traceback
                log.exception("a publication could not be scored")

    def _affordable(self, reserve_s: float = 0.0) -> bool:
        """Refill this thread's allowance with its share of the cores' time; return whether more than ``reserve_s``
        CPU seconds are left."""
        now_s, used_s = time.monotonic(), time.thread_time()
        share = tuned.SCORING_SHARE + (tuned.LOOK_BACK_SHARE if self._moving() else 0.0)
        gained_s = share * usable_cores() * (now_s - self._asked_s) - (used_s - self._used_s)
        self._allowance_s = min(self._allowance_s + gained_s, tuned.ALLOWANCE_S)
        self._asked_s, self._used_s = now_s, used_s
        return self._allowance_s > reserve_s

    def _score_shown(self, frame: Frame) -> None:
        """Score what was shown when a held-out frame was taken, if the next random instant has come; these
        are as frequent as ``SHOWN_SHARE`` allows."""
        taken_ns = frame.generated_edge_ns
        found = next(((p, s) for p, s in reversed(self._recent) if p.published_ns <= taken_ns), None)
        if found is None or taken_ns < self._next_shown_ns[frame.camera] or not self._affordable():
            return
        if found[0].published_ns < self._left_out_ns <= taken_ns:  # another one was shown
            return
        every_s = self._shown_cost_s * len(self._held_out) / (tuned.SHOWN_SHARE * usable_cores())
        gap_s = self._rng.exponential(min(every_s, tuned.SHOWN_EVERY_S))
        self._next_shown_ns[frame.camera] = taken_ns + round(gap_s * 1e9)
        publication, snapshot = found
        begun_s, full = time.thread_time(), self._shown_count % tuned.FULL_EVERY == 0
        score = self._held_out[frame.camera].score_newest(taken_ns, snapshot.at(taken_ns), psnr_only=not full)
        self._shown_cost_s = time.thread_time() - begun_s
        self._shown_count += 1
        if score is not None:
            self._on_shown(score, publication)

    def _score_later(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        self._recent.append((publication, renderer))
        self._forget_snapshots()
        if not self._affordable(tuned.RESERVE_S):
            return
        if self._moving() and self._looked_at % tuned.LOOKS_A_SCORE:
            self._look_back()
            return
        self._open[publication.number] = []
        while len(self._open) > tuned.OPEN_PUBLICATIONS:
            del self._open[min(self._open)]
        self._views = views
        for camera in self._held_out.values():
            self._finish(camera.publish(publication, renderer))
        self._look_back()

    def _moving(self) -> bool:
        """Whether a held-out camera moves."""
        return any(camera.so_far for camera in self._held_out.values())

    def _look_back(self, whole: bool = False) -> None:
        """For each moving held-out camera, score its newest frame and the next of its frames so far from the newest
        field. whole: all of its frames so far."""
        known = [(camera, truth) for camera in self._held_out.values() for truth in camera.so_far]
        if not known or not self._recent:
            return
        snapshot = self._recent[-1][1]
        newest = [(camera, camera.so_far[-1]) for camera in self._held_out.values() if camera.so_far]
        # In turn: if time runs out, the frames not reached are those that were scored most recently.
        turn = [known[(self._looked_at + k) % len(known)] for k in range(len(known) if whole else 1)]
        self._looked_at += 1
        for camera, truth in [*newest, *turn]:
            if time.monotonic() > self._ends_s:
                break
            if (score := camera.frame_score(truth, snapshot)) is not None:
                self._frame_scores[truth] = score
        every = {truth for _, truth in known}
        self._frame_scores = {truth: score for truth, score in self._frame_scores.items() if truth in every}
        now = [truth for _, truth in newest if truth in self._frame_scores]
        if now:
            last = max(now, key=lambda truth: truth.taken_ns)
            self.so_far = so_far(list(self._frame_scores.values()), self._frame_scores[last])

    def _forget_snapshots(self) -> None:
        """Drop snapshots that were replaced before the next capture at which what is shown is scored."""
        newest_ns = {name: c.truths[-1].taken_ns if c.truths else 0 for name, c in self._held_out.items()}
        since_ns = max(newest_ns.values()) - tuned.SILENT_CAMERA_NS
        next_ns = min(max(self._next_shown_ns[name], t_ns) for name, t_ns in newest_ns.items() if t_ns >= since_ns)
        while len(self._recent) > 1 and self._recent[1][0].published_ns <= next_ns:
            self._recent.popleft()

    def _finish(self, found: Sequence[Scored]) -> None:
        for each in found:
            publication = each.publication
            if publication.number not in self._open:
                continue
            scores = self._open[publication.number]
            scores.append(each.score)
            truth, over = each.truth.image(), self._scorer.background
            if publication.number % tuned.BASELINE_EVERY == 0 and self._views:
                self.baselines.add(baseline(self._views, truth, each.truth.frame.pose.matrix(), over))
            comparison = Comparison(each.score.camera, opaque(truth, over), to_bytes(each.rendered), publication.number)
            final = len(scores) == len(self._held_out)
            self._on_scored(publication.scored(mean_score(scores)), comparison, final)
            if final:
                del self._open[publication.number]

    def _score_selected(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        if self._new_publications:  # a newer one is waiting: this one stays unscored
            return
        whole = [(v if v.whole is None else v.whole() or v) for v in views]
        renderings = [(v.camera, renderer.render(v.camera_to_world, v.intrinsics).color, v.image) for v in whole]
        score = self._scorer.score_selected(renderings, publication.published_ns)
        if score is None:
            return
        turn, left = divmod(self._selected_scored, tuned.BASELINE_EVERY)
        over = self._scorer.background
        self._selected_scored += 1
        if left == 0:
            one_of_them = whole[turn % len(whole)]  # in turn: the mean is that of all
            self.baselines.add(Baseline(mean_color_db([v.image for v in whole], one_of_them.image, over)))
        camera, image, truth = renderings[0]
        comparison = Comparison(camera, opaque(truth, over), to_bytes(image), publication.number)
        self._on_scored(publication.scored(score), comparison, True)
