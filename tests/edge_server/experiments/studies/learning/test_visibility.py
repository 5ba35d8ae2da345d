"""What cameras see of what moves, as the scene has it, and whether an embedding tells it."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.studies.learning.visibility import SEES, SeesMotion, VisibleMotion, area, embedding_areas
from edge_server.experiments.studies.learning.workshop import workshop
from edge_server.experiments.training.scheduler.setting import seeds
from edge_server.experiments.training.scheduler.workers import WorkerPool
from edge_server.scheduler.learned.state import State

SIDES = {
    "south": {"cam04", "cam05", "cam12", "cam13", "cam17"},
    "east": {"cam02", "cam04", "cam09"},
    "north": {"cam01", "cam09", "cam10", "cam18"},
    "west": {"cam03", "cam05", "cam10"},
}


def test_the_area_is_the_share_of_pairs_in_the_right_order():
    scores = np.array([3.0, 1.0, 2.0, 0.0])
    assert area(scores, np.array([True, True, False, False])) == 0.75
    assert area(-scores, np.array([True, True, False, False])) == 0.25
    assert area(np.ones(4), np.array([True, True, False, False])) == 0.5
    assert np.isnan(area(scores, np.ones(4, bool)))


@pytest.fixture(scope="module")
def moments():
    setting = dataclasses.replace(workshop(1.0), parts=("age", "pose"))
    with WorkerPool(Folders()) as pool:
        return VisibleMotion(setting), [m for e in pool.draw(setting, seeds(3, "test", 6)[2:]) for m in e]


@pytest.mark.slow
def test_cameras_of_one_side_see_it_and_no_others(moments):
    (visible, drawn), sides = moments, set()
    for moment in drawn:
        shares = visible.shares(moment)
        seeing = {c for c, share in shares.items() if share > SEES}
        on = [side for side, cameras in SIDES.items() if seeing and seeing <= cameras]
        assert on or not seeing, "two sides at once"
        sides |= set(on[:1])
        chosen = SeesMotion(visible, 2).choice(moment)
        assert len(chosen.cameras) == 2 and chosen.at_ns == moment.now_ns
        assert len(seeing) < 2 or set(chosen.cameras) <= {c for c, share in shares.items() if share > 0.0}
    assert len(sides) > 1  # it is on another side in another episode


@pytest.mark.slow
def test_an_embedding_that_tells_is_told_from_one_that_does_not(moments):
    (visible, drawn), rng = moments, np.random.default_rng(0)

    def seen_as(signal: float) -> list:
        found = []
        for m in drawn:
            shares = visible.shares(m)
            knows = np.array([shares.get(c, 0.0) > SEES for c in m.cameras], float)
            noise = rng.normal(size=(len(m.cameras), 4)).astype(np.float32)
            noise[:, 0] += np.float32(signal) * knows.astype(np.float32)
            s = m.state
            state = State(s.ages_ms, s.poses, noise, s.reported, s.cameras)
            found.append(dataclasses.replace(m, state=state))
        return found

    tells, camera = embedding_areas(visible, seen_as(6.0))
    nothing, same = embedding_areas(visible, seen_as(0.0))
    assert tells > 0.98 and nothing < 0.75 and camera == same
