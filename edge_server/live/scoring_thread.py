"""Scores publications, and what is shown between them, on a thread of its own, so that neither ingest nor
the field waits for it.

A publication's renderer is kept until the held-out capture nearest to its present has arrived; it then
renders that capture's pose, and the two images are compared. If scoring falls behind, publications stay
unscored (nulls in the series) and nothing queues up. The thread's own computing, without the
rendering in the field's workers, is a bounded share of the machine's.

What was shown is scored at random captures of each held-out camera: the publication that was the newest one
at that instant, extrapolated to it (``Snapshot.at``), as the page renders it for a visitor who moves.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.baselines import BaselineMean, baseline
from edge_server.fidelity.scorer import Score, Scorer, mean_score
from edge_server.fields import View
from edge_server.live.state import Comparison, Publication, Snapshot
from freshfield import payload
from freshfield.frame import Frame
from freshfield.machine_load import usable_cores
from freshfield.scenario import seed_sequence

log = logging.getLogger(__name__)

# Niceness: scoring serves observers and gives way to the field's updates.
_NICE = 5
# Items that wait while one publication is scored; older ones are no longer needed.
_INBOX = 256
_OPEN_PUBLICATIONS = 16
_KEPT_FRAMES = 128
_BASELINE_EVERY = 5
_KEPT_RENDERINGS = 32
# A held-out frame may arrive late; the publication that was shown at its capture must still be kept then.
_KEPT_PUBLICATIONS = 32
_SHOWN_EVERY_S = 0.4  # largest mean time between two scores of what a held-out camera is shown
_FULL_EVERY = 4  # one in this many scores of what is shown has all metrics, the others only PSNR
# This thread may use a share of the cores' time, refilling an allowance of CPU seconds. What is shown may use
# its part of that share; publications are scored only while the reserve, CPU seconds, is left for it.
_SHARE, _SHOWN_SHARE, _ALLOWANCE_S, _RESERVE_S = 0.03, 0.02, 1.0, 0.1


@dataclass
class _OpenPublication:
    """A publication of which some held-out cameras are still to be scored."""

    publication: Publication
    scores: list[Score]


class ScoringThread:
    """The thread that owns the scorer.

    held_out: ids of the held-out cameras; where there are none, the selected views are scored.
    on_scored(publication with scores, comparison or None, final): called on this thread. final: the scores of
    all held-out cameras are in.
    on_shown(score, publication): ``score`` rates what was shown at ``score.published_ns``, ``publication``
    extrapolated to that instant. Called on this thread.
    seed: determines the random instants.
    """

    def __init__(
        self,
        held_out: Sequence[str],
        scorer: Scorer,
        on_scored: Callable[[Publication, Comparison | None, bool], None],
        on_shown: Callable[[Score, Publication], None],
        seed: int = 0,
    ) -> None:
        self._held_out = tuple(held_out)
        self._scorer = scorer
        self._on_scored = on_scored
        self._on_shown = on_shown
        self._rng = np.random.default_rng(seed_sequence(seed, "shown"))
        self._recent: deque[tuple[Publication, Snapshot]] = deque(maxlen=_KEPT_PUBLICATIONS)
        self._next_shown_ns = dict.fromkeys(self._held_out, 0)
        self._shown_count, self._shown_cost_s = 0, np.inf  # cost of the last score of what is shown, CPU s
        self._allowance_s, self._asked_s, self._used_s = _ALLOWANCE_S, time.monotonic(), 0.0
        self._inbox: deque[Frame | tuple[Publication, Snapshot, list[View]]] = deque(maxlen=_INBOX)
        self._wake = threading.Condition()
        self._ending = False
        self._frames: dict[str, deque[Frame]] = {c: deque(maxlen=_KEPT_FRAMES) for c in self._held_out}
        self._open: dict[int, _OpenPublication] = {}
        self._views: list[View] = []
        self._rendered: dict[tuple[str, int], NDArray[np.float32]] = {}
        self.undecodable = 0
        self.baselines = BaselineMean()
        self._thread = threading.Thread(target=self._main, name="scoring", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> None:
        """Score what has arrived, and end."""
        with self._wake:
            self._ending = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def held_out_frame(self, frame: Frame) -> None:
        """A held-out frame has arrived; it is decoded when it is compared with. Never blocks."""
        self._put(frame)

    def published(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        self._put((publication, renderer, views))

    def _put(self, item: Frame | tuple[Publication, Snapshot, list[View]]) -> None:
        with self._wake:
            self._inbox.append(item)
            self._wake.notify()

    def _main(self) -> None:
        try:
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        except (OSError, AttributeError):
            log.debug("thread priority cannot be lowered here")
        try:
            self._scorer.warm_up()
        except Exception:  # it costs scores, not the thread
            log.exception("a metric could not be loaded")
        # Loading is not charged: the allowance would be gone for half a minute.
        self._asked_s, self._used_s = time.monotonic(), time.thread_time()
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._inbox or self._ending)
                if not self._inbox:
                    return
                item = self._inbox.popleft()
            try:
                if isinstance(item, Frame):
                    self._score_with(item)
                elif self._held_out:
                    self._recent.append(item[:2])
                    if self._affordable(_RESERVE_S):
                        self._score_later(*item)
                else:
                    self._score_selected(*item)
            except Exception:  # one bad image must not end all scoring; it is logged with its traceback
                log.exception("a publication could not be scored")

    def _affordable(self, reserve_s: float = 0.0) -> bool:
        """Refill this thread's allowance with its share of the cores' time; whether more than ``reserve_s``
        CPU seconds are left."""
        now_s, used_s = time.monotonic(), time.thread_time()
        gained_s = _SHARE * usable_cores() * (now_s - self._asked_s) - (used_s - self._used_s)
        self._allowance_s = min(self._allowance_s + gained_s, _ALLOWANCE_S)
        self._asked_s, self._used_s = now_s, used_s
        return self._allowance_s > reserve_s

    def _score_shown(self, frame: Frame) -> None:
        """Score what was shown when a held-out frame was taken, if the next random instant has come; these
        are as frequent as _SHOWN_SHARE allows."""
        taken_ns = frame.generated_edge_ns
        found = next(((p, s) for p, s in reversed(self._recent) if p.published_ns <= taken_ns), None)
        if found is None or taken_ns < self._next_shown_ns[frame.camera] or not self._affordable():
            return
        every_s = self._shown_cost_s * len(self._held_out) / (_SHOWN_SHARE * usable_cores())
        gap_s = self._rng.exponential(min(every_s, _SHOWN_EVERY_S))
        self._next_shown_ns[frame.camera] = taken_ns + round(gap_s * 1e9)
        publication, snapshot = found
        begun_s, full = time.thread_time(), self._shown_count % _FULL_EVERY == 0
        score = self._scorer.newest(
            frame.camera,
            lambda at_ns: snapshot.at(at_ns).render(frame.pose.matrix(), frame.intrinsics).color,
            psnr_only=not full,
        )
        self._shown_cost_s = time.thread_time() - begun_s
        self._shown_count += 1
        if score is not None:
            self._on_shown(score, publication)

    def _score_later(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        self._open[publication.number] = _OpenPublication(publication, [])
        while len(self._open) > _OPEN_PUBLICATIONS:
            del self._open[min(self._open)]
        self._views = views
        for camera in self._held_out:
            render = self._render_later(camera, renderer, publication.published_ns)
            self._finish(self._scorer.publish(camera, render, publication.published_ns))

    def _render_later(self, camera: str, renderer: Snapshot, published_ns: int) -> Callable[[int], NDArray[np.float32]]:
        def render(generated_ns: int) -> NDArray[np.float32]:
            frame = next(f for f in self._frames[camera] if f.generated_edge_ns == generated_ns)
            image = renderer.render(frame.pose.matrix(), frame.intrinsics).color
            self._rendered[(camera, published_ns)] = image
            while len(self._rendered) > _KEPT_RENDERINGS:  # their publication's scoring failed afterwards
                self._rendered.pop(next(iter(self._rendered)))
            return image

        return render

    def _score_with(self, frame: Frame) -> None:
        self._frames[frame.camera].append(frame)
        scores = self._scorer.held_out(frame.camera, lambda: self._decode(frame), frame.generated_edge_ns, frame.pose)
        self._finish(scores)
        self._score_shown(frame)

    def _decode(self, frame: Frame) -> NDArray[np.uint8]:
        k = frame.intrinsics
        try:
            return payload.decode(frame.payload, frame.codec, k.width, k.height)
        except payload.PayloadError:
            self.undecodable += 1
            raise

    def _finish(self, scores: Sequence[Score]) -> None:
        for score in scores:
            image = self._rendered.pop((score.camera, score.published_ns), None)
            entry = next((o for o in self._open.values() if o.publication.published_ns == score.published_ns), None)
            if entry is None:
                continue
            entry.scores.append(score)
            comparison = None
            if image is not None:
                comparison = self._compare(score, image, entry.publication.number)
            final = len(entry.scores) == len(self._held_out)
            self._on_scored(entry.publication.scored(mean_score(entry.scores)), comparison, final)
            if final:
                self._open.pop(entry.publication.number, None)

    def _compare(self, score: Score, image: NDArray[np.float32], number: int) -> Comparison | None:
        assert score.truth_gap_ms is not None
        generated_ns = score.published_ns + round(score.truth_gap_ms * 1e6)
        frames = self._frames[score.camera]
        frame = min(frames, key=lambda f: abs(f.generated_edge_ns - generated_ns))
        truth = self._decode(frame)
        if number % _BASELINE_EVERY == 0 and self._views:
            self.baselines.add(baseline(self._views, truth, frame.pose.matrix()))
        return Comparison(score.camera, truth[..., :3], to_bytes(image), number)

    def _score_selected(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        with self._wake:
            if any(isinstance(i, tuple) for i in self._inbox):
                return  # a newer publication is waiting: this one stays unscored
        whole = [(v if v.whole is None else v.whole() or v) for v in views]
        renderings = [(v.camera, renderer.render(v.camera_to_world, v.intrinsics).color, v.image) for v in whole]
        score = self._scorer.score_selected(renderings, publication.published_ns)
        if score is None:
            return
        camera, image, truth = renderings[0]
        comparison = Comparison(camera, truth[..., :3], to_bytes(image), publication.number)
        self._on_scored(publication.scored(score), comparison, True)


def to_bytes(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """float (H, W, 3) in [0, 1] to uint8, rounded."""
    return (np.clip(image, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8)
