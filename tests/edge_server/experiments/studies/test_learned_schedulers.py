"""Studies of learned schedulers: their cases are sound, their verdicts can come out either way; one runs whole."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.studies.learned_schedulers import LEFT_OUT, WEIGHTED, WHICH_VIEWS
from edge_server.experiments.studies.learning import FOUR_VIEWPOINTS, REPORT, TRAININGS
from edge_server.experiments.studies.registry import LEARNING, STUDIES
from edge_server.experiments.studies.study import StudyRequest, judge
from edge_server.experiments.training.evaluation import BASELINE_POLICIES
from tests.edge_server.experiments.studies.invented import answers

FIXED = {"random": 0.0, "all": 0.5, "threshold:40": 0.4, "threshold:80": 0.6, "wait:0": 0.4, "wait:60": 0.6}


def table_of(levels: Mapping[str, float], trainings: int = 3, seeds: int = 12, **labels: Any) -> SeedTable:
    """Every policy earns its level, but for what the seed does to all and a little luck. Names with a blank are of
    learned policies, each of several trainings."""
    rng = np.random.default_rng(1)
    shared = rng.normal(size=seeds)
    rows = []
    for name, level in levels.items():
        policy, _, value = name.partition(":")
        runs: list[dict[str, Any]] = [{"value": float(value)} if value else {}]
        if policy.startswith("learned") or " by " in policy:
            runs = [{"training": run} for run in range(trainings)]
        for run in runs:
            for seed in range(seeds):
                reward = 5.0 + level + shared[seed] + 0.01 * rng.normal()
                rows.append({"policy": policy, **run, **labels, "seed": seed, "reward": reward})
    return SeedTable(
        [
            {"case": "a case", "judged_by": "its reward", "judged_from": place, **row}
            for row in rows
            for place in ("elsewhere", "where it is rewarded")
        ]
    )


def test_cases_judge_by_cameras_that_neither_reward_nor_train(tmp_path: Path):
    assert set(FOUR_VIEWPOINTS).isdisjoint(REPORT) and TRAININGS[False] >= 3
    for name in LEARNING:
        cases = STUDIES[name].cases(StudyRequest(False, tmp_path, Folders()))
        assert len({case.name for case in cases}) == len(cases) > 0, name
        for case in cases:
            apart = {*case.setting.judging, *case.setting.rewarding}
            assert set(case.setting.judging).isdisjoint(case.setting.rewarding)
            assert apart.isdisjoint(case.setting.scenario.training)
            assert all((t.setting or case.setting).rewarding == case.setting.rewarding for t in case.trainings)
            rewards = [*case.rewards.values(), *(t.reward for t in case.trainings if t.reward is not None)]
            assert rewards and all(reward.weights.get("age", -1.0) < 0.0 for reward in rewards), "age is a cost"


@pytest.mark.parametrize(("gain", "said"), [(1.0, "holds"), (-1.0, "does not hold")])
def test_claims_hold_if_and_only_if_what_was_learned_is_better(gain: float, said: str):
    baselines = dict.fromkeys(BASELINE_POLICIES, 0.2)
    oracles = {"oracle wait": 0.6, "oracle threshold": 0.6}
    by_state = {f"select by {variant}": 3.0 - 0.5 * gain * (3 - k) for k, variant in enumerate(WHICH_VIEWS)}
    by_state |= {
        f"{kind} by {v}": 3.0 - 0.5 * gain * k for kind in ("threshold", "wait") for k, v in enumerate(LEFT_OUT)
    }
    by_reward = {f"learned by {name}": 3.0 - gain * (name != "moving") for name in WEIGHTED}
    for name, levels, claim in (
        ("ppo-select", {**baselines, "learned": 3.0 * gain, "oracle": 1.0, "oracle threshold": 0.6}, "random set"),
        ("ppo-wait", {**oracles, "learned wait": 3.0 * gain, "learned threshold": 3.0 * gain}, "best fixed omega"),
        ("ppo-wait", {**oracles, "learned wait": 3.0 + gain, "learned threshold": 3.0}, "waiting beats thresholds"),
        ("ablation", {**by_state, "wait-arrived:60": 0.6}, "better by Z, age, pose than"),
        ("weights", by_reward, "it matters"),
        ("drift", {"learned before": 3.0, "learned afterwards": 3.0 + 0.5 * gain}, "on the new channel"),
    ):
        found = judge(STUDIES[name], table_of({**FIXED, **levels}, judged_by="moving"))
        assert answers(found, claim) == {said}, name
