"""Scores at the poses and exposures that a field has learned, where it corrects its cameras.

Such a field moves into the gauge of its corrected poses. A held-out frame is rendered at its given pose as corrected
by the views before and after it, without a look at the frame itself; its score stands beside the one at the given pose.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fields import RefinesCameras, Renderer, View


def render_refined(renderer: Renderer, view: View) -> NDArray[np.float32] | None:
    """What ``view`` saw, (H, W, 3), at the renderer's correction; None if it corrects nothing."""
    known = renderer.correction(view) if isinstance(renderer, RefinesCameras) else None
    if known is None:
        return None
    return known.exposed(renderer.render(known.camera_to_world, view.intrinsics).color)


def with_refined(
    score: Score, image: NDArray[np.float32] | None, view: View, scorer: Scorer, mask: NDArray[np.bool_] | None = None
) -> Score:
    """``score`` with the refined scores of ``image``, see ``render_refined``; as it was for None."""
    if image is None:
        return score
    found = scorer.score(view.camera, image, 0, view.image, 0, mask=mask, lpips=False)
    return replace(score, psnr_refined_db=found.psnr_db, ssim_refined=found.ssim)
