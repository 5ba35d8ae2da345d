"""Which views of a scan do not fit the others, once it is fitted: their poses or their pictures are wrong."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Field, RefinesCameras, View

# A view is named that reads so many dB less than the median, and so many standard deviations of them all: some views of
# a recording are blurred or show more detail. What reads more than LOOKS_RIGHT_DB fits, whatever the others read.
MISFIT_DB, DEVIATIONS, LOOKS_RIGHT_DB = 6.0, 4.0, 30.0
MOST_NAMED = 5  # views; of the others their number is said


def misfits(field: Field, views: Sequence[View], scorer: Scorer) -> list[str]:
    """A line of text for each of the views that were learned, but do not look as rendered at their corrected poses:
    the worst first. None where the field corrects nothing."""
    if not (isinstance(field, RefinesCameras) and field.correction(views[0]) is not None):
        return []
    scores = [score_views(field, [view], scorer)[0].psnr_refined_db for view in views]
    db = np.array([np.nan if score is None else score for score in scores])
    usual = float(np.nanmedian(db))
    deviation_db = 1.4826 * float(np.nanmedian(np.abs(db - usual)))  # of normally distributed ones
    least = min(usual - max(MISFIT_DB, DEVIATIONS * deviation_db), LOOKS_RIGHT_DB)
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
    more = len(lines) - MOST_NAMED
    return [*lines[:MOST_NAMED], f"and {more} more frames"] if more > 0 else lines
