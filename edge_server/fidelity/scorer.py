"""Scores publications against the truth at the present.

The present is the instant of publication. The held-out camera's capture nearest to it may not have arrived
yet, so a rendering waits here until a capture at or after that instant has arrived:

    scorer.publish(camera, rendering, published_ns)        # keeps the rendering
    scores = scorer.held_out(camera, image, generated_ns)  # the scores that this capture completes

Where nothing is held out, ``score_selected`` scores on the views the field was trained on (6.21)-(6.22), and
the score says so.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.images import BLACK, Color, Image, ImageError, to_unit
from edge_server.fidelity.moving_pixels import BOUND, LAGS_MS, NoiseEstimate, frames_at_lags, moving_mask
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.ssim import TAPS, ssim
from freshfield.scenario import NOTHING_HELD_OUT

log = logging.getLogger(__name__)

# Longer than the longest lag, so that the frame nearest to it is still here at low frame rates.
HISTORY_MS = LAGS_MS[-1] + 1000.0
HISTORY_FRAMES = 128
# Renderings that wait for their truth. More than this means that no held-out frames arrive.
MAX_PENDING = 8
# The truth may be half a period from the present; the rest allows for jitter of a real camera's clock.
GAP_PERIODS = 0.55

SHOWN = ("psnr_db", "psnr_moving_db", "psnr_still_db", "ssim", "lpips")
"""The scores that are reported of what was shown."""
SELECTED = "selected"
"""Stands for a held-out camera's name where nothing is held out: a score on the views trained on."""

Load = Callable[[], NDArray]
# A rendering, or a function that makes it once the truth's generation time is known: by then a moving
# held-out camera has another pose.
Render = NDArray | Callable[[int], NDArray]


def fidelity_title(scored_on: Iterable[str | None]) -> str:
    """Title of scores on these kinds of truth (``Publication.scored_on``): training views are no truth at the
    present."""
    return f"Fidelity on {NOTHING_HELD_OUT}" if SELECTED in scored_on else "Fidelity at the present"


class PerceptualMetric(Protocol):
    """LPIPS of one network."""

    network: str
    minimum_side: int

    def __call__(self, rendering: NDArray, truth: NDArray) -> float: ...


@dataclass(frozen=True)
class Score:
    """Fidelity of one rendering.

    camera: the held-out camera, or several joined by commas.
    published_ns: the present.
    psnr_db: over the whole image.
    psnr_moving_db: over the pixels that are known to move; None where none are.
    psnr_still_db: over the other pixels; None where all move.
    ssim, lpips: None where the image is too small, lpips also without weights.
    truth_gap_ms: capture of the truth minus the present; None on selected views.
    moving_share: share of the pixels that are known to move.
    on: the kind of truth.
    """

    camera: str
    published_ns: int
    psnr_db: float
    psnr_moving_db: float | None
    ssim: float | None
    lpips: float | None
    truth_gap_ms: float | None
    moving_share: float = 0.0
    on: Literal["held-out", "selected"] = "held-out"
    psnr_still_db: float | None = None


@dataclass(eq=False)
class _Frame:
    generated_ns: int
    load: Load
    viewpoint: Hashable = None
    background: Color = BLACK
    # As decoded: 8-bit images take an eighth of the memory of the metrics' float64.
    image: NDArray | None = None
    compared: bool = False  # with the frame before, for the noise

    def pixels(self) -> Image:
        if self.image is None:
            self.image = self.load()
        return to_unit(self.image, "held-out frame", self.background)


@dataclass
class _Camera:
    frames: deque[_Frame] = field(default_factory=lambda: deque(maxlen=HISTORY_FRAMES))
    pending: deque[tuple[int, Render]] = field(default_factory=lambda: deque(maxlen=MAX_PENDING))
    noise: NoiseEstimate = field(default_factory=NoiseEstimate)

    def pixels(self, frame: _Frame) -> Image | None:
        """The frame's image. A frame that cannot be decoded is removed from the history, so that it fails
        only once."""
        try:
            return frame.pixels()
        except ValueError as error:
            log.warning("a held-out frame is left out: %s", error)
            if frame in self.frames:
                self.frames.remove(frame)
            return None


class Scorer:
    """Keeps a short history of each held-out camera and the renderings that wait for it.

    lpips: an ``Lpips`` or None.
    noisy_truth: held-out frames are real video, so that the bound of moving pixels follows their noise.
    period_ms: period of the held-out cameras; None takes the median gap of their frames.
    background: color that held-out images with alpha are composited over.
    Not thread-safe.
    """

    def __init__(
        self,
        lpips: PerceptualMetric | None = None,
        noisy_truth: bool = False,
        period_ms: float | None = None,
        background: Color = BLACK,
    ) -> None:
        self._lpips = lpips
        self._noisy_truth = noisy_truth
        self._period_ms = period_ms
        self._background = background
        self._cameras: dict[str, _Camera] = {}
        self.unscored = 0  # renderings whose truth never came within half a period

    def warm_up(self) -> None:
        """Load what the metrics would load at their first distance; for LPIPS this takes two CPU seconds."""
        blank = np.zeros((64, 64, 3), np.uint8)
        self.score("", blank, 0, blank, 0)

    def publish(self, camera: str, rendering: Render, published_ns: int) -> list[Score]:
        """Keep a rendering (H, W, 3) in [0, 1] of held-out ``camera``, or a function of the truth's
        generation time that makes it, published at ``published_ns``; returns the scores that are complete
        already."""
        pending = self._camera(camera).pending
        if len(pending) == MAX_PENDING:
            self.unscored += 1  # the oldest falls off the deque
        pending.append((published_ns, rendering))
        return self._score_ready(camera)

    def held_out(
        self, camera: str, image: NDArray | Load, generated_ns: int, viewpoint: Hashable = None
    ) -> list[Score]:
        """Take a held-out frame; returns the scores it completes, oldest first.

        image: uint8 or floating (H, W, 3 or 4), or a function that decodes it when it is needed.
        generated_ns: time of its capture; a frame that is not later than the one before means a clock jump or
        a new session, and restarts the history.
        viewpoint: a moving camera's pose; moving pixels are looked for among frames of the same viewpoint.
        """
        state = self._camera(camera)
        if state.frames and generated_ns <= state.frames[-1].generated_ns:
            state.frames.clear()
        load: Load = image if callable(image) else (lambda: image)
        state.frames.append(_Frame(generated_ns, load, viewpoint, self._background))
        oldest = generated_ns - round(HISTORY_MS * 1e6)
        # A waiting rendering may be older than the history: the frames it needs are kept.
        if state.pending:
            oldest = min(oldest, state.pending[0][0] - round(HISTORY_MS * 1e6))
        while state.frames[0].generated_ns < oldest:
            state.frames.popleft()
        return self._score_ready(camera)

    def newest(self, camera: str, rendering: Callable[[int], NDArray], psnr_only: bool = False) -> Score | None:
        """Score what was shown when the newest held-out frame of ``camera`` was taken; None if the camera's
        period is not known yet, or its frame cannot be decoded.

        rendering: makes the rendering for the frame's generation time.
        psnr_only: as for ``score``. Raises ImageError as ``score``.
        """
        state, period = self._camera(camera), self.period_ms(camera)
        if not state.frames or period is None:
            return None
        taken_ns = state.frames[-1].generated_ns
        return self._against_nearest(camera, state, period, taken_ns, rendering, psnr_only)

    def score(
        self,
        camera: str,
        rendering: NDArray,
        published_ns: int,
        truth: NDArray,
        generated_ns: int,
        earlier: Sequence[NDArray] = (),
        bound: float = BOUND,
        psnr_only: bool = False,
    ) -> Score:
        """Score one rendering against one truth.

        rendering, truth: as ``images.to_unit`` takes them, of one size.
        published_ns, generated_ns: the present, and the capture time of the truth.
        earlier: earlier truths of the same camera, which show what pixels move.
        bound: difference in [0, 1] above which a pixel moves.
        psnr_only: the other metrics, which cost more, are None.
        Raises ImageError for NaN, infinity or a wrong shape in either image.
        """
        a = to_unit(rendering, "rendering")
        b = to_unit(truth, "held-out frame", self._background)
        moving = moving_mask(b, earlier, bound)
        total = psnr(a, b)
        assert total is not None  # no mask was given
        side = 0 if psnr_only else min(a.shape[:2])
        return Score(
            camera=camera,
            published_ns=published_ns,
            psnr_db=total,
            psnr_moving_db=psnr(a, b, moving),
            psnr_still_db=psnr(a, b, ~moving),
            ssim=ssim(a, b) if side >= TAPS else None,
            lpips=self._lpips(a, b) if self._lpips is not None and side >= self._lpips.minimum_side else None,
            truth_gap_ms=(generated_ns - published_ns) / 1e6,
            moving_share=float(moving.mean()),
        )

    def score_selected(self, renderings: Sequence[tuple[str, NDArray, NDArray]], published_ns: int) -> Score | None:
        """Mean score, metric by metric, over (camera, rendering, selected image) (6.22); None for no
        renderings."""
        scores = [self.score(c, r, published_ns, image, published_ns) for c, r, image in renderings]
        if not scores:
            return None
        return replace(mean_score(scores), truth_gap_ms=None, on="selected")

    def period_ms(self, camera: str) -> float | None:
        """The given period, else the median gap of the camera's frames; None before the second frame."""
        if self._period_ms is not None:
            return self._period_ms
        times = [f.generated_ns for f in self._camera(camera).frames]
        return float(np.median(np.diff(times))) / 1e6 if len(times) > 1 else None

    def _camera(self, name: str) -> _Camera:
        return self._cameras.setdefault(name, _Camera())

    def _score_ready(self, camera: str) -> list[Score]:
        state = self._camera(camera)
        done: list[Score] = []
        # The nearest capture is known once one at or after the present has arrived.
        period = self.period_ms(camera)
        if period is None:
            return done  # with one frame it is unknown whether it is near enough
        while state.frames and state.pending and state.frames[-1].generated_ns >= state.pending[0][0]:
            published_ns, rendering = state.pending.popleft()
            try:
                score = self._against_nearest(camera, state, period, published_ns, rendering)
            except ValueError as error:  # a bad rendering or truth costs only this publication
                log.warning("%s: a publication goes unscored: %s", camera, error)
                score = None
            if score is None:
                self.unscored += 1
            else:
                done.append(score)
        return done

    def _against_nearest(
        self,
        camera: str,
        state: _Camera,
        period_ms: float,
        published_ns: int,
        rendering: Render,
        psnr_only: bool = False,
    ) -> Score | None:
        frames = list(state.frames)
        times = [f.generated_ns for f in frames]
        nearest = min(range(len(times)), key=lambda i: abs(times[i] - published_ns))
        if abs(times[nearest] - published_ns) > GAP_PERIODS * period_ms * 1e6:
            return None
        truth = state.pixels(frames[nearest])
        if truth is None:
            return None
        viewpoint = frames[nearest].viewpoint
        known = frames[nearest].compared or nearest == 0 or frames[nearest - 1].viewpoint != viewpoint
        if self._noisy_truth and not known:
            frames[nearest].compared = True
            before = state.pixels(frames[nearest - 1])
            if before is not None:
                state.noise.add(before, truth)
        lags = frames_at_lags(times, times[nearest])
        found = [state.pixels(frames[i]) for i in lags if frames[i].viewpoint == viewpoint]
        earlier = [image for image in found if image is not None]
        bound = state.noise.bound if self._noisy_truth else BOUND
        image = rendering(times[nearest]) if callable(rendering) else rendering
        return self.score(camera, image, published_ns, truth, times[nearest], earlier, bound, psnr_only)


def mean_score(scores: Sequence[Score]) -> Score:
    """Mean over several held-out cameras of one publication; a metric is averaged over the cameras that have
    it. Raises ImageError for no scores."""
    if not scores:
        raise ImageError("no scores to average")
    means: dict[str, Any] = {}
    for name in (*SHOWN, "truth_gap_ms", "moving_share"):
        known = [v for s in scores if (v := getattr(s, name)) is not None]
        means[name] = float(np.mean(known)) if known else None
    return replace(scores[0], camera=",".join(dict.fromkeys(s.camera for s in scores)), **means)
