"""Which views of a scan do not fit the others, once it is fitted: their poses or their pictures are wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edge_server.experiments import experiment_constants as tuned
from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Field, RefinesCameras, View


def misfits(field: Field, views: Sequence[View], scorer: Scorer) -> list[str]:
    """A line of text for each of the views that were learned, but do not look as rendered at their corrected poses:
    the worst first. None where the field corrects nothing."""
    if not (isinstance(field, RefinesCameras) and field.correction(views[0]) is not None):
        return []
    scores = [score_views(field, [view], scorer)[0].psnr_refined_db for view in views]
    db = np.array([np.nan if score is None else score for score in scores])
    usual = float(np.nanmedian(db))
    deviation_db = 1.4826 * float(np.nanmedian(np.abs(db - usual)))  # of normally distributed ones
    least = min(usual - max(tuned.MISFIT_DB, tuned.MISFIT_DEVIATIONS * deviation_db), tuned.LOOKS_RIGHT_DB)
    lines = []
    for k in np.argsort(db, kind="stable"):
        known = field.correction(views[k])
        if not db[k] < least or known is None:
            continue
        moved_m = float(np.linalg.norm(known.camera_to_world[:3, 3] - views[k].camera_to_world[:3, 3]))
        lines.append(
            f"frame {views[k].camera}: its pose does not fit its picture, or it shows something else: {db[k]:.1f} dB, "
            f"the others {usual:.1f}, though its pose was moved by {moved_m:.2g} m; leave it out"
        )
    more = len(lines) - tuned.MISFITS_NAMED
    return [*lines[: tuned.MISFITS_NAMED], f"and {more} more frames"] if more > 0 else lines
