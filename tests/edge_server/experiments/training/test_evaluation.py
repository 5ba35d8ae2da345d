"""The oracle does not mistake luck for something to be won, and seeds without a value are not counted."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.rollouts.episode import Outcome
from edge_server.experiments.training.evaluation import Candidate, Evaluation
from edge_server.scheduler.learned.rewards import Reward

OMEGAS = (20, 40, 60, 80, 100, 120, 150, 200, 300, 500)
BY_PSNR = Reward("psnr", psnr=1.0, ssim=0.0, distance=0.0)


def outcome(psnr_db: float | None) -> dict[str, Outcome]:
    return {"cam00": Outcome(psnr_db, *[None] * 4, views=1.0, wait_ms=0.0)}


def evaluation_of(rng: np.random.Generator, matters: float) -> Evaluation:
    """Twenty seeds of four decisions, at each of which one omega is better than the others by ``matters`` spreads of a
    fit's luck."""
    best = rng.integers(len(OMEGAS), size=(20, 4))
    fixed = [Candidate({"policy": "threshold", "value": float(omega)}, f"threshold:{omega}") for omega in OMEGAS]
    fits = []
    for k in range(len(OMEGAS) + 2):
        gain = matters * (best == k)
        fits.append({at: [outcome(20.0 + rng.normal() + gain[at]) for _ in range(2)] for at in np.ndindex(20, 4)})
    others = [Candidate({"policy": name}, name) for name in ("random", "learned")]
    return Evaluation([*fixed, *others], fits)


def table_of(found: Evaluation) -> SeedTable:
    return SeedTable(found.rows(BY_PSNR, ["cam00"]))


def test_the_best_of_several_is_chosen_by_one_fit_and_measured_by_the_other():
    fits = {"a": [3.0, 0.5], "b": [1.0, 2.0], "c": [None, 9.0]}
    outcomes = [{(0, 0): [outcome(v) for v in values]} for values in fits.values()]
    found = table_of(Evaluation([Candidate({"policy": name}, name) for name in fits], outcomes))
    # The first fit prefers a, which the second has at 0.5; the second prefers b, which the first has at 1.
    assert found.values("reward", policy="oracle") == {0: pytest.approx(0.75)}
    assert found.values("reward", policy="a") == {0: 1.75} and found.values("reward", policy="c") == {0: None}


def test_a_seed_that_lacks_a_value_is_not_counted_and_a_decision_that_nobody_has_one_for_is_left_out_for_all():
    found = evaluation_of(np.random.default_rng(0), 0.0)
    whole = table_of(found).values("reward", policy="learned")
    found.fits[-1][3, 1] = [outcome(None)] * 2
    assert table_of(found).values("reward", policy="learned")[3] is None
    for of in found.fits:
        of[3, 1] = [outcome(None)] * 2
        of |= {(4, n): [outcome(None)] * 2 for n in range(4)}
    mine = table_of(found).values("reward", policy="learned")
    expected = [fit["cam00"].psnr_db for n in (0, 2, 3) for fit in found.fits[-1][3, n]]
    assert mine[3] == pytest.approx(np.mean(expected)) and mine[4] is None and mine[5] == whole[5]
