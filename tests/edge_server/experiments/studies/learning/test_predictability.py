"""What can be foreseen from ages: found where it is there, and not where it is not."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.experiments.studies.learning.ppo_wait import foreseen
from edge_server.experiments.studies.learning.predictability import by_ages
from edge_server.experiments.training.scheduler.episode import DecisionPoint, Outcome
from edge_server.experiments.training.scheduler.evaluation import Evaluation
from edge_server.scheduler.learned.rewards import Reward
from edge_server.scheduler.learned.state import State

CAMERAS = ("a", "b", "c")


def moment(seed: int, number: int, ages_ms: list[float], reported: bool = True) -> DecisionPoint:
    state = State(np.array(ages_ms), np.zeros((3, 6)), None, np.full(3, reported), CAMERAS)
    return DecisionPoint(seed, number, 0, 0, CAMERAS, (), state)


def evaluation(informative: bool) -> tuple[Evaluation, list[DecisionPoint]]:
    """Sixteen seeds of four decisions: at half of them ages are young. told: then it is best not to wait,
    else to wait; otherwise a coin has that."""
    rng = np.random.default_rng(5)
    found = Evaluation(Reward("psnr", psnr=1.0, ssim=0.0, distance=0.0), {"wait:0": {}, "wait:60": {}})
    moments = []
    for seed in range(16):
        for number in range(4):
            young = (seed + number) % 2 == 0
            now = young if informative else bool(rng.random() < 0.5)
            moments.append(moment(seed, number, (rng.uniform(0.5, 1.0, 3) * (30.0 if young else 300.0)).tolist()))
            for name, better in (("wait:0", now), ("wait:60", not now)):
                psnr = 20.0 + better + 0.01 * rng.normal()
                found.outcomes[name][seed, number] = Outcome(psnr, None, None, None, None, 0.0, 3.0, 0.0)
    return found, moments


def test_what_ages_tell_is_found_and_nothing_where_they_tell_nothing():
    found, moments = evaluation(True)
    gain = by_ages(found, "wait", moments)
    assert gain.count == 16 and gain.mean == pytest.approx(0.5, abs=0.1) and gain.above(0.0)
    assert foreseen("here", "wait", gain).verdict == "holds"
    found, moments = evaluation(False)
    assert by_ages(found, "wait", moments).above(0.0) is not True


def test_decisions_without_ages_or_rewards_are_left_out():
    found, moments = evaluation(True)
    silent = [moment(m.seed, m.number, [np.nan] * 3, reported=False) for m in moments[:4]]
    assert by_ages(found, "wait", [*silent, *moments[4:]]).count == 15
    assert by_ages(found, "wait", silent).count == 0
    found.outcomes["wait:0"].clear()
    gain = by_ages(found, "wait", moments)
    assert gain.count == 0 and foreseen("here", "wait", gain).verdict == "undecided"
