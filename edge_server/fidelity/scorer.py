"""Scores what the edge publishes against the truth at the present.

The present is the instant of publication. The held-out camera's capture nearest to it may not have
arrived yet, so a rendering waits here until a capture at or after it has (or until the wait is hopeless):

    scorer.publish(camera, rendering, published_ns)      # keeps the rendering
    scores = scorer.held_out(camera, image, generated_ns)  # whatever has become scorable

Where nothing is held out, ``score_selected`` takes the views the field was trained on (6.21)-(6.22), and
the score says so.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.images import BLACK, Colour, Image, ImageError, same_size, to_unit
from edge_server.fidelity.moving_pixels import BOUND, LAGS_MS, NoiseEstimate, frames_at_lags, moving_mask
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.ssim import TAPS, ssim

log = logging.getLogger(__name__)

# One lag more than the longest, so that the frame nearest to it is still here at ten frames a second.
HISTORY_MS = LAGS_MS[-1] + 1000.0
HISTORY_FRAMES = 128
# Renderings that wait for their truth. More would mean that no held-out frame comes at all.
PENDING = 8
# The truth may be half a period from the present; a tenth more lets a real camera's clock jitter.
GAP_PERIODS = 0.55

Load = Callable[[], NDArray]
# What was rendered, or a function that renders it once the truth's generation time is known: a held-out
# camera that moves has another pose by then.
Render = NDArray | Callable[[int], NDArray]


class PerceptualMetric(Protocol):
    """LPIPS, or its stand-in (fidelity.perceptual), as far as the scorer needs it."""

    network: str
    minimum_side: int

    def __call__(self, rendering: NDArray, truth: NDArray) -> float: ...


@dataclass(frozen=True)
class Score:
    """Fidelity of one publication.

    published_ns: the present. psnr_moving_db: None where nothing moves or nothing is known to. ssim and
    lpips: None where the image is too small for them, lpips also without weights. truth_gap_ms: truth's
    capture minus the present (None on selected views). on: what it was compared with. perceptual: None unless
    it is asked for; it is not LPIPS, see fidelity.perceptual.
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
    perceptual: float | None = None


@dataclass(eq=False)
class _Frame:
    generated_ns: int
    load: Load
    viewpoint: Hashable = None
    background: Colour = BLACK
    # Kept as decoded: 8-bit images take an eighth of the room that metrics need for a moment.
    image: NDArray | None = None

    def pixels(self) -> Image:
        if self.image is None:
            self.image = self.load()
        return to_unit(self.image, "held-out frame", self.background)


@dataclass
class _Camera:
    frames: deque[_Frame] = field(default_factory=lambda: deque(maxlen=HISTORY_FRAMES))
    pending: deque[tuple[int, Render]] = field(default_factory=lambda: deque(maxlen=PENDING))
    noise: NoiseEstimate = field(default_factory=NoiseEstimate)

    def pixels(self, frame: _Frame) -> Image | None:
        """The frame's image; one that cannot be decoded leaves the history, so that it fails once."""
        try:
            return frame.pixels()
        except ValueError as error:
            log.warning("a held-out frame is left out: %s", error)
            if frame in self.frames:
                self.frames.remove(frame)
            return None


class Scorer:
    """Keeps a short history of each held-out camera and the renderings that wait for it.

    lpips: an ``Lpips`` or None. noisy_truth: held-out frames are real video, so the bound of moving pixels
    follows their noise. period_ms: of the held-out cameras; None takes the median gap of their frames.
    background: under held-out images with alpha. perceptual: a ``Perceptual`` or None. Not thread-safe: one
    owner.
    """

    def __init__(
        self,
        lpips: PerceptualMetric | None = None,
        noisy_truth: bool = False,
        period_ms: float | None = None,
        background: Colour = BLACK,
        perceptual: PerceptualMetric | None = None,
    ) -> None:
        self._lpips = lpips
        self._perceptual = perceptual
        self._noisy_truth = noisy_truth
        self._period_ms = period_ms
        self._background = background
        self._cameras: dict[str, _Camera] = {}
        self.unscored = 0  # renderings whose truth never came within half a period

    def publish(self, camera: str, rendering: Render, published_ns: int) -> list[Score]:
        """Keep a rendering (H, W, 3) in [0, 1] of held-out ``camera``, or a function of the truth's
        generation time that makes it; returns what is scorable already."""
        pending = self._camera(camera).pending
        if len(pending) == PENDING:
            self.unscored += 1  # the oldest falls off the deque
        pending.append((published_ns, rendering))
        return self._settle(camera)

    def held_out(
        self, camera: str, image: NDArray | Load, generated_ns: int, viewpoint: Hashable = None
    ) -> list[Score]:
        """Take a held-out frame, uint8 or floating (H, W, 3 or 4), or a function that decodes it when it
        is needed; returns the scores it completes, oldest first. Frames come in order of capture; one
        that does not is a clock's jump or a new session and starts the history afresh. Moving pixels are
        looked for among frames of the same ``viewpoint`` (a moving camera's pose), which may be None."""
        state = self._camera(camera)
        if state.frames and generated_ns <= state.frames[-1].generated_ns:
            state.frames.clear()
        load: Load = image if callable(image) else (lambda: image)
        state.frames.append(_Frame(generated_ns, load, viewpoint, self._background))
        oldest = generated_ns - round(HISTORY_MS * 1e6)
        # A rendering may be older than the history is long: what it needs is kept while it waits.
        if state.pending:
            oldest = min(oldest, state.pending[0][0] - round(HISTORY_MS * 1e6))
        while state.frames[0].generated_ns < oldest:
            state.frames.popleft()
        return self._settle(camera)

    def score(
        self,
        camera: str,
        rendering: NDArray,
        published_ns: int,
        truth: NDArray,
        generated_ns: int,
        earlier: Sequence[NDArray] = (),
        bound: float = BOUND,
    ) -> Score:
        """Score one rendering against one truth; ``earlier`` truths tell which pixels move.

        Raises ImageError for NaN, infinity or a wrong shape in either image.
        """
        a = to_unit(rendering, "rendering")
        b = to_unit(truth, "held-out frame", self._background)
        same_size(a, b)
        moving = moving_mask(b, earlier, bound)
        total = psnr(a, b)
        assert total is not None  # no mask was given
        side = min(a.shape[:2])

        def by(metric: PerceptualMetric | None) -> float | None:
            return metric(a, b) if metric is not None and side >= metric.minimum_side else None

        return Score(
            camera=camera,
            published_ns=published_ns,
            psnr_db=total,
            psnr_moving_db=psnr(a, b, moving),
            ssim=ssim(a, b) if side >= TAPS else None,
            lpips=by(self._lpips),
            perceptual=by(self._perceptual),
            truth_gap_ms=(generated_ns - published_ns) / 1e6,
            moving_share=float(moving.mean()),
        )

    def score_selected(
        self, renderings: Sequence[tuple[str, NDArray, NDArray]], published_ns: int
    ) -> Score | None:
        """Mean score over (camera, rendering, selected image), (6.22) metric by metric; None for none."""
        scores = [self.score(c, r, published_ns, image, published_ns) for c, r, image in renderings]
        if not scores:
            return None
        return replace(mean_score(scores), truth_gap_ms=None, on="selected")

    def period_ms(self, camera: str) -> float | None:
        """The camera's period as given, else the median gap of its frames; None before the second."""
        if self._period_ms is not None:
            return self._period_ms
        times = [f.generated_ns for f in self._camera(camera).frames]
        return float(np.median(np.diff(times))) / 1e6 if len(times) > 1 else None

    def _camera(self, name: str) -> _Camera:
        return self._cameras.setdefault(name, _Camera())

    def _settle(self, camera: str) -> list[Score]:
        state = self._camera(camera)
        done: list[Score] = []
        # The nearest capture is known once one at or after the present has arrived.
        period = self.period_ms(camera)
        if period is None:
            return done  # the first frame cannot tell yet whether it is near enough
        while state.frames and state.pending and state.frames[-1].generated_ns >= state.pending[0][0]:
            published_ns, rendering = state.pending.popleft()
            try:
                score = self._against_nearest(camera, state, period, published_ns, rendering)
            except ValueError as error:  # a bad rendering or truth costs this publication, no other
                log.warning("%s: a publication goes unscored: %s", camera, error)
                score = None
            if score is None:
                self.unscored += 1
            else:
                done.append(score)
        return done

    def _against_nearest(
        self, camera: str, state: _Camera, period_ms: float, published_ns: int, rendering: Render
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
        if self._noisy_truth and nearest > 0 and frames[nearest - 1].viewpoint == viewpoint:
            before = state.pixels(frames[nearest - 1])
            if before is not None:
                state.noise.add(before, truth)
        lags = frames_at_lags(times, times[nearest])
        found = [state.pixels(frames[i]) for i in lags if frames[i].viewpoint == viewpoint]
        earlier = [image for image in found if image is not None]
        bound = state.noise.bound if self._noisy_truth else BOUND
        image = rendering(times[nearest]) if callable(rendering) else rendering
        return self.score(camera, image, published_ns, truth, times[nearest], earlier, bound)


def listed_metric(metrics: Sequence[str]) -> PerceptualMetric | None:
    """The stand-in for LPIPS where a scenario's ``edge.metrics`` lists it. Raises ValueError with the reason
    where it cannot be had."""
    if "perceptual" not in metrics:
        return None
    from edge_server.fidelity.perceptual import open_perceptual

    metric, missing = open_perceptual()
    if metric is None:
        raise ValueError(f"edge.metrics: {missing}")
    return metric


def mean_score(scores: Sequence[Score]) -> Score:
    """Mean over several held-out cameras of one publication; a metric that some lack is averaged over
    those that have it."""
    if not scores:
        raise ImageError("no scores to average")

    def mean(values: list[float | None]) -> float | None:
        known = [v for v in values if v is not None]
        return float(np.mean(known)) if known else None

    return replace(
        scores[0],
        camera=",".join(dict.fromkeys(s.camera for s in scores)),
        psnr_db=float(np.mean([s.psnr_db for s in scores])),
        psnr_moving_db=mean([s.psnr_moving_db for s in scores]),
        ssim=mean([s.ssim for s in scores]),
        lpips=mean([s.lpips for s in scores]),
        perceptual=mean([s.perceptual for s in scores]),
        truth_gap_ms=mean([s.truth_gap_ms for s in scores]),
        moving_share=float(np.mean([s.moving_share for s in scores])),
    )
