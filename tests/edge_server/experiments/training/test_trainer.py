"""Training: continued bit for bit after a stop, and it learns."""

from __future__ import annotations

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from edge_server.experiments.common.seed_table import SeedTable, difference
from edge_server.experiments.engine import Engine
from edge_server.experiments.rollouts.episode import Outcome
from edge_server.experiments.rollouts.rollout import Decided, Run
from edge_server.experiments.rollouts.setting import Setting, seeds
from edge_server.experiments.training.evaluation import Candidate, evaluate, fixed_candidates
from edge_server.experiments.training.train_command import main
from edge_server.experiments.training.trainer import TrainingConfig, TrainingError, read_log, sibling_advantages, train
from edge_server.scheduler import make_policy
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import Reward, make_reward
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.experiments.rollouts.small import NOTHING, RAW, setting, thresholds

REWARD = make_reward("set", distance=0.0)
CONFIG = TrainingConfig(Spec("select", StateLayout(("age", "pose")), hidden=16), REWARD, episodes=6, batch=2)


def same(a: Learner, b: Learner) -> bool:
    return all(np.array_equal(w, b.actor.weights[name]) for name, w in a.actor.weights.items())


def quiet(line: str) -> None:
    del line


def trained(out: Path, of: Setting | None = None, config: TrainingConfig = CONFIG, say=quiet) -> Learner:
    return train(of or setting(), config, NOTHING, 1, out, say)


def test_a_stopped_training_continues_bit_for_bit(tmp_path: Path):
    def stop(line: str) -> None:
        if line.startswith("4/6"):
            raise KeyboardInterrupt

    whole = trained(tmp_path / "whole")
    Learner(CONFIG.spec, 77).save(tmp_path / "whole/other.npz")
    (tmp_path / "parts").mkdir()
    (tmp_path / "whole/other.npz").rename(tmp_path / "parts/policy.npz")  # of an earlier training
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parts", say=stop)
    assert len(read_log(tmp_path / "parts")) == 2 and not (tmp_path / "parts/policy.npz").exists()
    parts = trained(tmp_path / "parts")
    assert same(whole, parts) and same(Learner.load(tmp_path / "parts/policy.npz"), parts)
    assert len(list((tmp_path / "parts").glob("weights-*.npz"))) == 1
    assert not same(whole, trained(tmp_path / "other", config=dataclasses.replace(CONFIG, seed=1)))
    with pytest.raises(TrainingError, match="other settings"):
        trained(tmp_path / "parts", setting(steps=5))


@pytest.mark.parametrize("damage", ["weights-*.npz", "training.jsonl"])
def test_a_training_with_damaged_files_is_refused_in_one_line(damage: str, tmp_path: Path):
    trained(tmp_path)
    (path,) = tmp_path.glob(damage)
    whole = path.read_bytes()
    for rest in (None, whole[: len(whole) // 2]):
        path.unlink() if rest is None else path.write_bytes(rest)
        with pytest.raises(TrainingError, match="choose another --out, or delete it"):
            trained(tmp_path)


@pytest.mark.slow
def test_it_learns_to_use_fresh_views_where_only_age_counts(tmp_path: Path):
    omegas = (30.0, 100.0, 400.0)
    spec = Spec("threshold", StateLayout(("age",)), omegas, hidden=16, learning_rate=1e-2)
    config = TrainingConfig(spec, Reward("age", 0.0, 0.0, 0.0, age=-0.01), episodes=60, batch=6)
    learner = trained(tmp_path, setting(steps=1), config)
    mine, fixed = Candidate({"policy": "learned"}, learner.actor), fixed_candidates([], ("random",))
    engine = Engine(threads=1, say=quiet)
    test_seeds = seeds(0, "test", 6)
    found = evaluate(setting(steps=1), NOTHING, engine, test_seeds, [*fixed, *thresholds(*omegas), mine])
    table = SeedTable(found.rows(config.reward, ["cam00"]))
    learned, middle = {"policy": "learned"}, {"policy": "threshold", "value": 100.0}
    ages = [np.mean(list(table.values("aaoi_ms", **of).values())) for of in (learned, middle)]
    assert ages[0] < ages[1]
    assert difference(table.runs("reward", policy="learned"), table.runs("reward", policy="random")).low > 0.0
    log = read_log(tmp_path)
    assert log[-1]["omega_ms"] < 60.0 < log[0]["omega_ms"]


def run_of(*decided: tuple[int, float | None]) -> Run:
    """A run with rewards (REWARD without SSIM: 0.02 PSNR) at these slots."""
    of = {slot: Outcome(None if r is None else 50.0 * r, *[None] * 4, 1.0, 0.0) for slot, r in decided}
    return Run([Decided(slot, {"": outcome}, [[1.0, 1.0]], 0, -0.7) for slot, outcome in of.items()])


def test_samples_are_compared_with_the_others_of_their_slot():
    by_psnr = Reward("psnr", 0.02, 0.0, 0.0)
    runs = [run_of((0, 1.0), (1, 2.0), (2, 3.0)), run_of((0, 4.0), (1, None)), run_of((0, 7.0), (2, 5.0))]
    found = sibling_advantages(runs, by_psnr)
    assert np.allclose(found[0], [1 - 5.5, np.nan, 3 - 5], equal_nan=True)
    assert np.allclose(found[1], [0.0, np.nan], equal_nan=True)
    assert np.allclose(found[2], [4.5, 2.0])
    assert np.allclose(sibling_advantages(runs[:1], by_psnr)[0], [1.0, 2.0, 3.0])


def test_only_a_first_batch_without_a_reward_ends_a_training(tmp_path: Path, monkeypatch):
    spec = Spec("threshold", StateLayout(("age",)), (50.0, 200.0), hidden=16)
    config = TrainingConfig(spec, Reward("psnr", 0.02, 0.0, 0.0), episodes=4, batch=1, samples=1)

    def log_of(out: Path, *runs: Run) -> list[dict]:
        given = iter(runs)
        module = "edge_server.experiments.training.trainer.run_rollouts"
        monkeypatch.setattr(module, lambda *a, **more: {"learner": {0: [[next(given)]]}})
        trained(out, config=config)
        return read_log(out)

    rows = log_of(tmp_path / "a", run_of((0, 1.0), (1, 1.2)), run_of(), run_of((0, None)), run_of((0, 1.1)))
    assert [row["decisions"] for row in rows] == [2, 0, 1, 1]
    assert [row["reward"] is None for row in rows] == [False, True, True, False]
    assert Learner.load(tmp_path / "a/policy.npz").updates == 2
    for first, said in ((run_of(), "nothing had arrived"), (run_of((0, None)), "it lacks psnr")):
        with pytest.raises(TrainingError, match=said):
            log_of(tmp_path / "b", first)
    assert not (tmp_path / "b/training.json").exists()


def test_a_reward_that_cannot_be_had_is_refused_after_the_first_batch(tmp_path):
    with pytest.raises(TrainingError, match=r"lpips.*--distance none"):
        trained(tmp_path, config=dataclasses.replace(CONFIG, reward=make_reward("set")))


def test_the_command_from_a_scenario_to_a_policy_that_decides(tmp_path: Path, capsys):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(RAW))
    asked = "--kind threshold --omegas 50,200 --episodes 2 --batch 1 --decisions 1 --fit-steps 2 --size 24 --jobs 1"
    out = tmp_path / "out"
    words = [str(tmp_path / "small.yaml"), *asked.split(), "--out", str(out)]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "2/2 episodes" in text and "rewarded from cam00\n" in text
    assert f"edge-server compare {words[0]} all bandit:{out / 'policy.npz'}" in text
    # The scenario asks for no LPIPS, so that the reward has no such term, wherever weights lie about.
    assert "term_lpips" not in next(csv.DictReader((out / "training.csv").open()))
    make_policy(f"bandit:{out / 'policy.npz'}", None, np.random.default_rng(0))
    before = (out / "training.csv").read_text()
    assert main(words) == 0  # finished: nothing is left to be trained
    assert (out / "training.csv").read_text() == before
    # What is refused costs nothing that was there.
    assert main([*words[:3], *words[5:]]) == 2 and "other settings" in capsys.readouterr().err
    assert (out / "policy.npz").exists()


@pytest.mark.stability
def test_a_still_scene_has_no_moving_pixels_and_training_says_so(tmp_path):
    still = setting()
    source = {**still.scenario.source, "speed_m_per_s": 0.0}
    still = dataclasses.replace(still, scenario=dataclasses.replace(still.scenario, source=source))
    of_motion = dataclasses.replace(CONFIG, reward=make_reward("set", fidelity="moving", distance=0.0))
    with pytest.raises(TrainingError, match=r"psnr_moving: nothing moves.*--on whole"):
        trained(tmp_path, still, of_motion)
    learner = trained(tmp_path / "whole", still)
    assert all(np.isfinite(w).all() for w in learner.actor.weights.values())
    assert all(row["reward"] is not None for row in read_log(tmp_path / "whole"))
