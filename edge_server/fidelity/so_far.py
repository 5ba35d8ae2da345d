"""What a field shows of a held-out camera that moves: now, and of all places so far.

Such a camera shows another view each time, so that one score after the other says nothing of the field. ``now`` is the
newest held-out frame; ``all`` is each held-out frame so far, rendered from the newest field.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from edge_server.fidelity import fidelity_constants as tuned
from edge_server.fidelity.refined import render_refined
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Renderer, View
from edge_server.run_records import SoFarScores


class FrameScore(NamedTuple):
    """PSNR in dB and SSIM of one frame, at refined pose and exposure if the field knows them."""

    psnr_db: float
    ssim: float | None
    refined: bool


def score_frame(renderer: Renderer, view: View, scorer: Scorer) -> FrameScore:
    """Score what a field shows of a held-out frame."""
    image = render_refined(renderer, view)
    shown = renderer.render(view.camera_to_world, view.intrinsics).color if image is None else image
    found = scorer.score(view.camera, shown, 0, view.image, 0, lpips=False)
    return FrameScore(found.psnr_db, found.ssim, image is not None)


def so_far(scores: Sequence[FrameScore], now: FrameScore) -> SoFarScores:
    """Of frames' scores, and that of the newest."""
    ssim = [score.ssim for score in scores if score.ssim is not None]
    return SoFarScores(
        now_psnr_db=now.psnr_db,
        now_ssim=now.ssim,
        all_psnr_db=float(np.mean([score.psnr_db for score in scores])),
        all_ssim=float(np.mean(ssim)) if ssim else None,
        frames=len(scores),
        refined=now.refined,
    )


def stays(number: int, count: int) -> bool:
    """Whether the frame of this number, counted from 0, stays with ``count`` so far: the newest, and at most
    SO_FAR_FRAMES others, evenly spread."""
    stride = 1 << (max(count - 1, 0) // tuned.SO_FAR_FRAMES).bit_length()
    return number % stride == 0 or number == count - 1
