"""Hindsight does not mistake luck for something to be won, and seeds without a value are not counted."""

from __future__ import annotations

import json

import numpy as np
import pytest

from edge_server.experiments.training.scheduler.episode import Outcome
from edge_server.experiments.training.scheduler.evaluation import HINDSIGHT, Evaluation
from edge_server.experiments.training.scheduler.report import lines, summary
from edge_server.scheduler.learned.rewards import Reward

OMEGAS = (20, 40, 60, 80, 100, 120, 150, 200, 300, 500)
BY_PSNR = Reward("psnr", psnr=1.0, ssim=0.0, distance=0.0)


def outcome(psnr_db: float | None) -> Outcome:
    return Outcome(psnr_db, *[None] * 5, views=1.0, wait_ms=0.0)


def evaluation_of(rng: np.random.Generator, matters: float, twice: bool = True) -> Evaluation:
    """Twenty seeds of four decisions, at each of which one omega is better than the others by ``matters``
    spreads of a fit's luck."""
    found = Evaluation(BY_PSNR)
    best = rng.integers(len(OMEGAS), size=(20, 4))
    for into in (found.outcomes, found.repeated)[: 2 if twice else 1]:
        for k, omega in enumerate(OMEGAS):
            into[f"threshold:{omega}"] = {
                (seed, n): outcome(20.0 + rng.normal() + matters * (best[seed, n] == k))
                for seed in range(20)
                for n in range(4)
            }
        into["random"] = {(s, n): outcome(20.0 + rng.normal()) for s in range(20) for n in range(4)}
    return found


def test_luck_is_not_something_to_be_won_and_a_real_difference_is():
    noise = [evaluation_of(np.random.default_rng(s), 0.0).best_values("threshold")["gain"] for s in range(60)]
    assert sum(gain.above(0.0) is True for gain in noise) <= 5  # it was all of them
    assert abs(np.mean([gain.mean for gain in noise])) < 0.03
    for s in range(10):
        gain = evaluation_of(np.random.default_rng(s), 5.0).best_values("threshold")["gain"]
        # 5 at the best of ten, against about a tenth of it for any fixed one.
        assert gain.above(0.0) is True and 3.5 < gain.mean < 5.2


def test_hindsight_of_luck_alone_is_no_better_than_random():
    gaps = []
    for s in range(40):
        found = evaluation_of(np.random.default_rng(s), 0.0)
        top, random = found.rewards(HINDSIGHT), found.rewards("random")
        gaps.append(np.mean([top[k] - random[k] for k in top]))
    assert abs(np.mean(gaps)) < 0.07  # four times its spread; the best of two fits each would be 1 above


def test_what_was_carried_out_once_tells_nothing_of_hindsight():
    found = evaluation_of(np.random.default_rng(0), 5.0, twice=False)
    assert set(found.rewards(HINDSIGHT).values()) == {None}
    best_values = found.best_values("threshold")
    assert best_values["quartiles"] == [None] * 3 and best_values["gain"].above(0.0) is None
    text = " ".join(lines(found, "random", "threshold"))
    assert "not known" in text
    json.dumps(summary(found, "random", "threshold"), allow_nan=False)


def test_seeds_without_a_value_are_not_counted():
    found = evaluation_of(np.random.default_rng(0), 0.0)
    found.outcomes["random"][3, 1] = outcome(None)
    assert found.seeds("random") == (20, 19)
    kept = summary(found, "random", "threshold")
    assert (kept["seeds"], kept["seeds_without_value"]) == (19, 1)
    assert "on 19 unseen seeds; 1 more have" in lines(found, "random", "threshold")[0]


def test_a_decision_that_nobody_has_a_value_for_is_left_out_for_all():
    found = evaluation_of(np.random.default_rng(0), 0.0)
    whole = found.rewards("random")
    for of in (found.outcomes, found.repeated):
        for name in of:
            of[name][3, 1] = outcome(None)
            of[name].update({(4, n): outcome(None) for n in range(4)})
    assert found.seeds("random") == (20, 19)
    values = [
        outcome.psnr_db
        for of in (found.outcomes, found.repeated)
        for outcome in (of["random"][3, n] for n in (0, 2, 3))
    ]
    mine = found.rewards("random")
    assert mine[3] == pytest.approx(np.mean(values)) and mine[4] is None and mine[5] == whole[5]
    assert found.rewards(HINDSIGHT)[3] is not None and found.best_values("threshold")["gain"].count == 19


def test_where_no_decision_has_a_value_the_summary_is_still_json():
    found = evaluation_of(np.random.default_rng(0), 0.0)
    for of in (found.outcomes, found.repeated):
        for name in of:
            of[name] = {at: outcome(None) for at in of[name]}
    kept = json.loads(json.dumps(summary(found, "random", "threshold"), allow_nan=False))
    assert kept["seeds"] == 0 and kept["best_value_by_decision"] == [None] * 3
    assert kept["reward"] == [None] * 3


def test_the_best_of_several_is_chosen_by_one_fit_and_measured_by_the_other():
    found = Evaluation(BY_PSNR)
    found.outcomes = {"a": {(0, 0): outcome(3.0)}, "b": {(0, 0): outcome(1.0)}, "c": {(0, 0): outcome(None)}}
    found.repeated = {"a": {(0, 0): outcome(0.5)}, "b": {(0, 0): outcome(2.0)}, "c": {(0, 0): outcome(9.0)}}
    # The first fit prefers a, which the second has at 0.5; the second prefers b, which the first has at 1.
    assert found.rewards(HINDSIGHT) == {0: pytest.approx(0.75)}
    assert found.rewards("a") == {0: 1.75} and found.rewards("c") == {0: None}


def test_the_best_fixed_value_is_chosen_on_seeds_that_it_is_not_measured_on():
    found = Evaluation(BY_PSNR)
    found.outcomes = {
        "threshold:1": {(s, 0): outcome(10.0 if s % 2 else 0.0) for s in range(6)},
        "threshold:2": {(s, 0): outcome(0.0 if s % 2 else 10.0) for s in range(6)},
        "wait:3": {(s, 0): outcome(99.0) for s in range(6)},
    }
    best, name = found.best_fixed("threshold")
    assert best == dict.fromkeys(range(6), 0.0) and name in ("threshold:1", "threshold:2")
