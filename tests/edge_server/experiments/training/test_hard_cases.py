"""Training where hardly anything works: nothing arrives, nothing moves, pictures are damaged, one camera.
Rewards that cannot be had teach nothing, everything stays finite, and it goes on learning afterwards."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from edge_server.experiments.engine import Engine
from edge_server.experiments.rollouts.episode import EpisodeFactory
from edge_server.experiments.rollouts.rollout import named, rollout
from edge_server.experiments.rollouts.setting import Setting, seeds
from edge_server.experiments.training.evaluation import evaluate, fixed_candidates
from edge_server.experiments.training.trainer import TrainingConfig, TrainingError, read_log, train
from edge_server.scheduler.learned.rewards import Reward, make_reward
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.experiments.rollouts.small import NOTHING, scenario, setting

pytestmark = pytest.mark.stability

REWARD = make_reward("set", distance=0.0)
SELECT = Spec("select", StateLayout(("age", "pose")), hidden=8)
WAIT = Spec("wait", StateLayout(("age",)), (0.0, 50.0, 150.0), hidden=8)
NEVER = {"faults": {"loss": {"probability": 1.0}}}


def config(spec: Spec = SELECT, reward: Reward = REWARD, **more) -> TrainingConfig:
    return TrainingConfig(spec, reward, **{"episodes": 6, "batch": 3, **more})


def weights_after(what: Setting, taught: TrainingConfig, out: Path) -> dict[str, np.ndarray]:
    found = train(what, taught, NOTHING, 1, out, lambda line: None).actor.weights
    assert all(np.isfinite(w).all() for w in found.values())
    return found


@pytest.mark.parametrize(("spec", "scratch"), [(SELECT, True), (WAIT, False)], ids=["select", "wait, warm"])
def test_where_nothing_ever_arrives_training_says_so_instead_of_learning_nothing(spec, scratch, tmp_path):
    silent = setting(NEVER, scratch=scratch)
    with pytest.raises(TrainingError, match="nothing had arrived"):
        weights_after(silent, config(spec), tmp_path)
    assert not (tmp_path / "policy.npz").exists()
    candidates = fixed_candidates(["threshold"], ("random",), {"threshold": (50.0,)})
    found = evaluate(silent, NOTHING, Engine(threads=1, say=lambda line: None), seeds(0, "test", 2), candidates)
    assert all(row["reward"] is None for row in found.rows(REWARD, ["cam00"]))


def test_a_still_scene_has_no_moving_pixels_and_training_says_so(tmp_path):
    still = setting()
    source = {**still.scenario.source, "speed_m_per_s": 0.0}
    still = dataclasses.replace(still, scenario=dataclasses.replace(still.scenario, source=source))
    with pytest.raises(TrainingError, match=r"psnr_moving: nothing moves.*--on whole"):
        weights_after(still, config(reward=make_reward("set", fidelity="moving", distance=0.0)), tmp_path)
    weights_after(still, config(), tmp_path / "whole")
    assert all(row["reward"] is not None for row in read_log(tmp_path / "whole"))


def test_damaged_late_and_doubled_frames(tmp_path):
    channel = {
        "preset": "ch6",
        "faults": {
            "corruption": {"probability": 0.3},
            "duplication": {"probability": 0.3},
            "blackout": {"windows_ms": [[0.0, 1000.0]]},
        },
    }
    weights_after(setting(channel), config(WAIT), tmp_path)
    assert all(row["reward"] is not None for row in read_log(tmp_path))


def test_one_camera_that_reports_and_one_that_rewards(tmp_path):
    alone = Setting(
        scenario(cameras={"count": 2, "held_out": ["cam00"]}), steps=3, decisions=2, lead_ms=800.0, span_ms=400.0
    )
    weights_after(alone, config(samples=2), tmp_path)
    # There is one set, so that no try is better than another.
    assert all(row["views"] == 1.0 for row in read_log(tmp_path))


def test_a_decision_of_nobody_is_an_outcome_without_scores():
    factory = EpisodeFactory(setting(NEVER), NOTHING)
    for name in ("all", "threshold:50", "wait:50", "random"):
        for decided in rollout(factory, 3, named(name))[0].decided:
            (outcome,) = decided.outcomes.values()
            assert outcome.psnr_db is None and outcome.views == 0.0 and np.isfinite(outcome.wait_ms)
