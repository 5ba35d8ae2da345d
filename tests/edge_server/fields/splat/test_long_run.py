"""Three hundred updates of a moving scene, warm starts only, against fields fitted afresh."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.experiments.scenes.multiview_sequence import synthetic_sequence
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget
from edge_server.fields.splat.settings import SplatSettings
from edge_server.fields.splat.still_field import StillField

pytestmark = pytest.mark.stability

UPDATES, FRESH_TIMES, NEAR_DB = 300, 15, 0.5
LAST = range(UPDATES - 9, UPDATES + 1)


@pytest.mark.slow
def test_three_hundred_updates_later_a_field_is_as_good_as_a_fresh_one() -> None:
    """Of Gaussians: room is made for new ones at every update, and the rest of the scene must outlast it."""
    sequence, steps = synthetic_sequence("room", 13, 48, 15.0, speed_m_per_s=1.0), 20

    def fresh(frame: int) -> StillField:
        field = StillField(SplatSettings(gaussians=2048, start=1024))
        field.fit(sequence.training(frame), Budget(steps=FRESH_TIMES * steps))
        return field

    scorer, follower, followed = Scorer(), fresh(0), []
    for frame in range(1, UPDATES + 1):
        follower.fit(sequence.training(frame), Budget(steps=steps))
        if frame in LAST:
            followed.append(sequence.score(follower, frame, scorer).psnr_db)
    known = [sequence.score(fresh(frame), frame, scorer).psnr_db for frame in LAST[::3]]
    never = sequence.score(fresh(0), UPDATES, scorer).psnr_db
    assert np.mean(followed) > np.mean(known) - NEAR_DB, (followed, known)
    assert np.mean(followed) > never + 1.0, "nothing moved: nothing was tested"
