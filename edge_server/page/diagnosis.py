"""Diagnoses a useless picture, and names the likely cause."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edge_server.fidelity.scorer import SELECTED
from edge_server.live.state import CameraView, Publication
from edge_server.page.page_constants import FLAT_MARGIN_DB, FLAT_SCORES, REFUSED_SHARE, STALE_MS
from edge_server.report.report_constants import TOO_SHORT


def poor_picture(flat_db: float | None, publications: Sequence[Publication], cameras: Sequence[CameraView]) -> str:
    """A warning if the latest pictures are no better than one mean color; otherwise empty.

    flat_db: PSNR of an image in the mean color of the training images; None: not known.
    publications: oldest first. cameras: of the run.
    """
    scores = [p.psnr_db for p in publications[-4 * FLAT_SCORES :] if p.psnr_db is not None][-FLAT_SCORES:]
    if flat_db is None or len(scores) < FLAT_SCORES or not np.mean(scores) <= flat_db + FLAT_MARGIN_DB:
        return ""
    held_out = next(p.scored_on for p in reversed(publications) if p.psnr_db is not None) != SELECTED
    return (
        f"The picture is no better than one mean color ({np.mean(scores):.1f} dB; that color {flat_db:.1f} dB). "
        f"Likely: {_cause([c for c in cameras if not c.held_out], held_out)}"
    )


def _cause(cameras: Sequence[CameraView], held_out: bool) -> str:
    """held_out: the score is on held-out views, which training cameras with little overlap do not cover."""
    ages_ms = [c.age_ms for c in cameras if c.age_ms is not None]
    refusing = [c.camera for c in cameras if c.rejected > REFUSED_SHARE * (c.delivered + c.rejected)]
    if len(ages_ms) < 2 <= len(cameras):
        return f"{len(ages_ms)} of {len(cameras)} cameras have sent a frame; see the logs of the others."
    if refusing:
        return f"the edge refuses frames of {', '.join(refusing)}; edge.json counts them by reason."
    if np.median(ages_ms or [0.0]) > STALE_MS:
        return f"frames are {np.median(ages_ms) / 1e3:.0f} s old; see the network."
    apart = "cameras that see different places (tab Coverage), " if held_out else ""
    return (
        f"poses or lenses that do not fit the images (axes, meters or millimeters, calibration), {apart}or {TOO_SHORT}."
    )
