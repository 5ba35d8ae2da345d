"""The latest frames of a held-out camera, and the publications that wait for theirs.

A publication is compared with the capture nearest to the present, the instant of publication. That capture may not
have arrived yet, so the publication waits until one at or after the present has arrived, at most half a period
away. A fixed camera is rendered at once, and the rendering waits. The pose of a moving one at the capture is not known
yet, so one snapshot of the field waits.
"""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.fidelity_constants import MOVING_BOUND, MOVING_LAGS_MS
from edge_server.fidelity.moving_pixels import NoiseEstimate, frames_at_lags
from edge_server.fidelity.refined import render_refined, with_refined
from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fidelity.so_far import FrameScore, score_frame, stays
from edge_server.fields import Snapshot, View
from edge_server.live import live_constants as tuned
from edge_server.live.state import Publication
from freshfield import payload
from freshfield.frame import Frame
from freshfield.geometry import Pose

log = logging.getLogger(__name__)

HISTORY_NS = round((MOVING_LAGS_MS[-1] + tuned.HISTORY_BEYOND_LAGS_MS) * 1e6)

Image = NDArray[np.float32]


@dataclass(eq=False)
class Truth:
    """A frame of a held-out camera. compared: with the frame before, for the noise. number: in ``so_far``."""

    frame: Frame
    compared: bool = False
    number: int = 0
    _image: NDArray[np.uint8] | None = None

    @property
    def taken_ns(self) -> int:
        return self.frame.generated_edge_ns

    def image(self) -> NDArray[np.uint8]:
        """The image (H, W, 3 or 4), decoded on first use: 8 bits take an eighth of the metrics' float64.
        Raises PayloadError."""
        if self._image is None:
            k = self.frame.intrinsics
            self._image = payload.decode(self.frame.payload, self.frame.codec, k.width, k.height)
        return self._image

    def forget(self) -> None:
        """Forget the decoded image."""
        self._image = None

    def view(self, image: NDArray[np.uint8]) -> View:
        """The frame as a view, with its image."""
        return View(self.frame.camera, image, self.frame.pose.matrix(), self.frame.intrinsics, self.taken_ns)


@dataclass(frozen=True)
class Scored:
    """A publication's rendering of a held-out camera, beside its truth."""

    publication: Publication
    score: Score
    truth: Truth
    rendered: Image


class HeldOutCamera:
    """The history of one camera. Not thread-safe.

    noisy: its frames are real video, so that the threshold of moving pixels follows their noise.
    undecodable: number of damaged frames so far.
    so_far: frames taken at another place than the one before, see ``fidelity.so_far``.
    """

    def __init__(self, camera: str, scorer: Scorer, noisy: bool = False) -> None:
        self.camera = camera
        self.undecodable = 0
        self.noise = NoiseEstimate()
        self.so_far: list[Truth] = []
        self._places = 0
        self.truths: deque[Truth] = deque(maxlen=tuned.HISTORY_FRAMES)
        self._scorer, self._noisy = scorer, noisy
        self._pending: deque[tuple[Publication, Image | Snapshot, Pose]] = deque()

    def publish(self, publication: Publication, snapshot: Snapshot) -> list[Scored]:
        """Queue a publication for its truth; returns those whose truth is known. It stays unscored before the camera's
        second frame, while ``MOST_PENDING`` wait, and while another one waits for a moving camera."""
        if len(self.truths) < 2 or len(self._pending) == tuned.MOST_PENDING:
            return []
        newest = self.truths[-1].frame
        if self.truths[-2].frame.pose == newest.pose:
            color = snapshot.render(newest.pose.matrix(), newest.intrinsics).color
            self._pending.append((publication, color, newest.pose))
        elif all(isinstance(waiting, np.ndarray) for _, waiting, _ in self._pending):
            self._pending.append((publication, snapshot, newest.pose))
        return self._complete()

    def take(self, frame: Frame) -> list[Scored]:
        """Take a frame; returns the publications that it completes, oldest first. One that is not later than the one
        before means a clock jump or a new session, and restarts the history."""
        if self.truths and frame.generated_edge_ns <= self.truths[-1].taken_ns:
            self.truths.clear()
        if self.truths and self.truths[-1].frame.pose != frame.pose:
            self._places += 1
            kept = [truth for truth in self.so_far if stays(truth.number, self._places)]
            self.so_far = [*kept, Truth(frame, number=self._places - 1)]
        self.truths.append(Truth(frame))
        # A waiting publication may be older than the history: the frames it needs are kept.
        waiting_ns = [publication.published_ns for publication, _, _ in self._pending]
        oldest_ns = min([frame.generated_edge_ns, *waiting_ns]) - HISTORY_NS
        while self.truths[0].taken_ns < oldest_ns:
            self.truths.popleft()
        return self._complete()

    def frame_score(self, truth: Truth, snapshot: Snapshot) -> FrameScore | None:
        """Score a frame of ``so_far``; None, and it is forgotten, if it cannot be decoded."""
        if (image := self._decode(truth)) is None:
            self.so_far = [other for other in self.so_far if other is not truth]
            return None
        truth.forget()
        return score_frame(snapshot, truth.view(image), self._scorer)

    def period_ns(self) -> float | None:
        """The median gap of the frames; None before the second."""
        times = [truth.taken_ns for truth in self.truths]
        return float(np.median(np.diff(times))) if len(times) > 1 else None

    def score_newest(self, taken_ns: int, snapshot: Snapshot, psnr_only: bool = False) -> Score | None:
        """Score ``snapshot`` against the newest frame, taken at ``taken_ns``; None before the second frame, or if the
        newest cannot be decoded."""
        if len(self.truths) < 2 or self.truths[-1].taken_ns != taken_ns:
            return None
        truth = self.truths[-1]
        found = self._against(truth, truth.taken_ns, snapshot, psnr_only)
        return None if found is None else found[0]

    def _complete(self) -> list[Scored]:
        """Score the waiting publications whose nearest capture is known: one at or after the present has arrived."""
        done: list[Scored] = []
        period_ns = self.period_ns()
        while period_ns and self._pending and self.truths:  # damaged ones are removed meanwhile
            if self.truths[-1].taken_ns < self._pending[0][0].published_ns:
                break
            publication, waiting, pose = self._pending.popleft()
            present_ns = publication.published_ns
            truth = min(self.truths, key=lambda truth: abs(truth.taken_ns - present_ns))
            moved = isinstance(waiting, np.ndarray) and truth.frame.pose != pose
            if moved or abs(truth.taken_ns - present_ns) > tuned.GAP_PERIODS * period_ns:
                continue
            try:
                found = self._against(truth, present_ns, waiting)
            except ValueError as error:  # a bad rendering costs only this publication
                log.warning("%s: a publication goes unscored: %s", self.camera, error)
                continue
            if found is not None:
                done.append(Scored(publication, found[0], truth, found[1]))
        return done

    def _against(
        self, truth: Truth, present_ns: int, shown: Image | Snapshot, psnr_only: bool = False
    ) -> tuple[Score, Image] | None:
        """Score of a rendering, or of what a snapshot shows from the truth's pose, and the rendering; None if the
        truth cannot be decoded. Raises ImageError as ``Scorer.score``."""
        truths = list(self.truths)
        number, pose = truths.index(truth), truth.frame.pose
        if (image := self._decode(truth)) is None:
            return None
        before = truths[number - 1] if number else None
        if self._noisy and not truth.compared and before is not None and before.frame.pose == pose:
            truth.compared = True
            if (earlier_image := self._decode(before)) is not None:
                self.noise.add(earlier_image, image)
        lags = frames_at_lags([each.taken_ns for each in truths], truth.taken_ns)
        found = [self._decode(truths[i]) for i in lags if truths[i].frame.pose == pose]
        earlier = [each for each in found if each is not None]
        bound = self.noise.bound if self._noisy else MOVING_BOUND
        view, refined = truth.view(image), None
        if not isinstance(shown, np.ndarray):
            refined = render_refined(shown, view)
            shown = shown.render(pose.matrix(), truth.frame.intrinsics).color
        score = self._scorer.score(self.camera, shown, present_ns, image, truth.taken_ns, earlier, bound, psnr_only)
        return with_refined(score, refined, view, self._scorer), shown if refined is None else refined

    def _decode(self, truth: Truth) -> NDArray[np.uint8] | None:
        """The frame's image. One that cannot be decoded is removed from the history, so that it fails only once."""
        try:
            return truth.image()
        except payload.PayloadError as error:
            log.warning("a held-out frame is left out: %s", error)
            self.undecodable += 1
            if truth in self.truths:
                self.truths.remove(truth)
            return None
