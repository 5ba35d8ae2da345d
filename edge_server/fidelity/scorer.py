"""The scores of one rendering against one truth, by every metric.

When a truth is one of the present is for who holds the truths: ``live.scoring.held_out`` for captures that arrive,
``experiments.virtual.truth`` in virtual time. Where nothing is held out, ``score_selected`` scores on the views
the field was trained on (6.21)-(6.22), and the score says so.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity import fidelity_constants as tuned
from edge_server.fidelity.images import BLACK, Color, ImageError, to_unit
from edge_server.fidelity.moving_pixels import moving_mask
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.ssim import TAPS, ssim
from freshfield.scenario import NOTHING_HELD_OUT

SHOWN = ("psnr_db", "psnr_moving_db", "psnr_still_db", "ssim", "lpips")
"""The scores that are reported of what was shown."""
METRICS = ("psnr_db", "psnr_moving_db", "ssim", "lpips", "psnr_refined_db", "ssim_refined")
"""Those of what was published."""
SELECTED = "selected"
"""Stands for a held-out camera's name where nothing is held out: a score on the views trained on."""


def fidelity_title(scored_on: Iterable[str | None]) -> str:
    """Title of scores on these kinds of truth (``Publication.scored_on``): training views are no truth at the
    present."""
    return f"Fidelity on {NOTHING_HELD_OUT}" if SELECTED in scored_on else "Fidelity at the present"


class PerceptualMetric(Protocol):
    """LPIPS, or what stands for it in a test."""

    minimum_side: int

    def __call__(self, rendering: NDArray, truth: NDArray, mask: NDArray[np.bool_] | None = None) -> float: ...


@dataclass(frozen=True)
class Score:
    """Fidelity of one rendering.

    camera: the held-out camera, or several joined by commas.
    published_ns: the present.
    psnr_db: over the whole image; as every score, within the mask if there is one.
    psnr_moving_db: over the pixels that are known to move; None where none are.
    psnr_still_db: over the other pixels; None where all move.
    ssim, lpips: None where the image, or for SSIM the mask, is too small; lpips also without weights.
    truth_gap_ms: capture of the truth minus the present; None on selected views.
    moving_share: share of the pixels that are known to move.
    on: the kind of truth.
    psnr_refined_db, ssim_refined: of a rendering at the pose and exposure that the field's corrections of other views
        suggest, the truth itself not looked at; None where the field corrects nothing.
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
    psnr_refined_db: float | None = None
    ssim_refined: float | None = None


class Scorer:
    """Scores renderings.

    lpips: an ``Lpips`` or None.
    background: color that truths with alpha are composited over.
    """

    def __init__(self, lpips: PerceptualMetric | None = None, background: Color = BLACK) -> None:
        self._lpips = lpips
        self.background = background

    def warm_up(self) -> None:
        """Load what the metrics would load at their first distance; for LPIPS this takes two CPU seconds."""
        blank = np.zeros((64, 64, 3), np.uint8)
        self.score("", blank, 0, blank, 0)

    def score(
        self,
        camera: str,
        rendering: NDArray,
        published_ns: int,
        truth: NDArray,
        generated_ns: int,
        earlier: Sequence[NDArray] = (),
        bound: float = tuned.MOVING_BOUND,
        psnr_only: bool = False,
        mask: NDArray[np.bool_] | None = None,
        lpips: bool = True,
    ) -> Score:
        """Score one rendering against one truth.

        rendering, truth: as ``images.to_unit`` takes them, of one size.
        published_ns, generated_ns: the present, and the capture time of the truth.
        earlier: earlier truths of the same camera, which show what pixels move.
        bound: difference in [0, 1] above which a pixel moves.
        psnr_only: the other metrics, which cost more, are None.
        mask: (H, W), the pixels to score; None: all.
        lpips: whether to score by it, too, which costs most.
        Raises ImageError for NaN, infinity or a wrong shape in either image, or a mask of nothing.
        """
        a = to_unit(rendering, "rendering")
        b = to_unit(truth, "held-out frame", self.background)
        moving = moving_mask(b, [to_unit(e, "earlier truth", self.background) for e in earlier], bound)
        total = psnr(a, b, mask)
        if total is None:
            raise ImageError("held-out frame: every pixel is masked")
        scored = np.ones_like(moving) if mask is None else mask
        side = 0 if psnr_only else min(a.shape[:2])
        perceptual = self._lpips if lpips else None
        return Score(
            camera=camera,
            published_ns=published_ns,
            psnr_db=total,
            psnr_moving_db=psnr(a, b, moving & scored),
            psnr_still_db=psnr(a, b, ~moving & scored),
            ssim=ssim(a, b, mask) if side >= TAPS else None,
            lpips=perceptual(a, b, mask) if perceptual is not None and side >= perceptual.minimum_side else None,
            truth_gap_ms=(generated_ns - published_ns) / 1e6,
            moving_share=float(moving[scored].mean()),
        )

    def score_selected(self, renderings: Sequence[tuple[str, NDArray, NDArray]], published_ns: int) -> Score | None:
        """Mean score, metric by metric, over (camera, rendering, selected image) (6.22); None for no
        renderings."""
        scores = [self.score(c, r, published_ns, image, published_ns) for c, r, image in renderings]
        if not scores:
            return None
        return replace(mean_score(scores), truth_gap_ms=None, on="selected")


def mean_score(scores: Sequence[Score]) -> Score:
    """Mean over several held-out cameras of one publication; a metric is averaged over the cameras that have
    it. Raises ImageError for no scores."""
    if not scores:
        raise ImageError("no scores to average")
    means: dict[str, Any] = {}
    for name in (*SHOWN, "truth_gap_ms", "moving_share", "psnr_refined_db", "ssim_refined"):
        known = [v for s in scores if (v := getattr(s, name)) is not None]
        means[name] = float(np.mean(known)) if known else None
    return replace(scores[0], camera=",".join(dict.fromkeys(s.camera for s in scores)), **means)
