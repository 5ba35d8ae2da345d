"""Three hundred updates of a moving scene, warm starts only, against fields fitted afresh.

``edge-server bench drift`` asks the same of full-sized fields; it takes minutes each.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Budget, Field
from edge_server.fields.registry import make_field
from edge_server.offline.film import Film, synthetic_film

UPDATES, NEAR_DB = 300, 0.5
LAST = range(UPDATES - 9, UPDATES + 1)


@pytest.fixture(scope="module")
def film() -> Film:
    """A person walks through the room."""
    return synthetic_film("room", 13, 48, 15.0, speed_m_per_s=1.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options", "steps", "from_scratch"),
    [("splat", {"gaussians": 2048, "start": 1024}, 20, 300), ("ngp", {"rays": 1024}, 10, 400)],
)
def test_three_hundred_updates_later_a_field_is_as_good_as_a_fresh_one(
    name: str, options: dict[str, Any], steps: int, from_scratch: int, film: Film
) -> None:
    def fresh(frame: int) -> Field:
        field = make_field(name, options)
        field.fit(film.training(frame), Budget(steps=from_scratch))
        return field

    scorer, follower, followed = Scorer(), fresh(0), []
    for frame in range(1, UPDATES + 1):
        follower.fit(film.training(frame), Budget(steps=steps))
        if frame in LAST:
            followed.append(film.score(follower, frame, scorer).psnr_db)
    known = [film.score(fresh(frame), frame, scorer).psnr_db for frame in LAST[::3]]
    never = film.score(fresh(0), UPDATES, scorer).psnr_db
    assert np.mean(followed) > np.mean(known) - NEAR_DB, (followed, known)
    assert np.mean(followed) > never + 1.0, "nothing moved: nothing was tested"
