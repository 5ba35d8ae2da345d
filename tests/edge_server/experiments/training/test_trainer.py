"""Training: continued bit for bit after a stop, and it learns; an evaluation in which luck wins nothing."""

import csv
import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.rollouts.episode import Outcome
from edge_server.experiments.rollouts.rollout import Decided, Run
from edge_server.experiments.rollouts.setting import Setting
from edge_server.experiments.training.evaluation import Candidate, Evaluation
from edge_server.experiments.training.train_command import main
from edge_server.experiments.training.trainer import TrainingConfig, TrainingError, read_log, sibling_advantages, train
from edge_server.scheduler import make_policy
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import Reward, make_reward
from edge_server.scheduler.learned.state import StateLayout
from tests.edge_server.experiments.rollouts.small import NOTHING, RAW, setting
from tests.edge_server.scheduler.learned.problems import same
from tests.support import refusal, refused

REWARD = make_reward("set", distance=0.0)
CONFIG = TrainingConfig(Spec("select", StateLayout(("age", "pose")), hidden=16), REWARD, episodes=4, batch=2)


def trained(out: Path, of: Setting | None = None, config: TrainingConfig = CONFIG, say=lambda _: None) -> Learner:
    return train(of or setting(), config, NOTHING, 1, out, say)


def test_a_stopped_training_continues_bit_for_bit(tmp_path: Path):
    def stop(line: str) -> None:
        if line.startswith("2/4"):
            raise KeyboardInterrupt

    whole = trained(tmp_path / "whole")
    Learner(CONFIG.spec, 77).save(tmp_path / "whole/other.npz")
    (tmp_path / "parts").mkdir()
    (tmp_path / "whole/other.npz").rename(tmp_path / "parts/policy.npz")  # of an earlier training
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parts", say=stop)
    assert len(read_log(tmp_path / "parts")) == 1 and not (tmp_path / "parts/policy.npz").exists()
    parts = trained(tmp_path / "parts")
    assert same(whole, parts) and same(Learner.load(tmp_path / "parts/policy.npz"), parts)
    assert len(list((tmp_path / "parts").glob("weights-*.npz"))) == 1
    assert not same(whole, trained(tmp_path / "other", config=dataclasses.replace(CONFIG, seed=1)))
    refused(TrainingError, "other settings", trained, tmp_path / "parts", setting(steps=5))


@pytest.mark.parametrize("damage", ["weights-*.npz", "training.jsonl"])
def test_a_training_with_damaged_files_is_refused_in_one_line(damage: str, tmp_path: Path):
    trained(tmp_path)
    (path,) = tmp_path.glob(damage)
    whole = path.read_bytes()
    for rest in (None, whole[: len(whole) // 2], whole.splitlines(keepends=True)[0]):
        path.unlink() if rest is None else path.write_bytes(rest)
        refused(TrainingError, "choose another --out, or delete it", trained, tmp_path)


def run_of(*rewards: float | None) -> Run:
    """A run with these rewards (REWARD without SSIM: 0.02 PSNR)."""
    outcomes = [Outcome(None if r is None else 50.0 * r, *[None] * 4, 1.0, 0.0) for r in rewards]
    return Run([Decided({"": outcome}, [[1.0, 1.0]], 0, -0.7) for outcome in outcomes])


def test_samples_are_compared_with_the_others_of_their_decision():
    by_psnr = Reward("psnr", 0.02, 0.0, 0.0)
    runs = [run_of(1.0, 2.0, 3.0), run_of(4.0, None, None), run_of(7.0, None, 5.0)]
    found = sibling_advantages(runs, by_psnr)
    expected = [[1 - 5.5, np.nan, 3 - 5], [0.0, np.nan, np.nan], [4.5, np.nan, 2.0]]
    assert np.allclose(found, expected, equal_nan=True)
    assert np.allclose(sibling_advantages(runs[:1], by_psnr), [[1.0, 2.0, 3.0]])


def test_only_a_first_batch_without_a_reward_ends_a_training(tmp_path: Path, monkeypatch):
    spec = Spec("threshold", StateLayout(("age",)), (50.0, 200.0), hidden=16)
    config = TrainingConfig(spec, Reward("psnr", 0.02, 0.0, 0.0), episodes=4, batch=1, samples=1)

    def log_of(out: Path, *runs: Run) -> list[dict]:
        given = iter(runs)
        module = "edge_server.experiments.training.trainer.run_rollouts"
        monkeypatch.setattr(module, lambda *a, **more: {"learner": {0: [[next(given)]]}})
        trained(out, config=config)
        return read_log(out)

    rows = log_of(tmp_path / "a", run_of(1.0, 1.2), run_of(None), run_of(None), run_of(1.1))
    assert [row["decisions"] for row in rows] == [2, 1, 1, 1]
    assert [row["reward"] is None for row in rows] == [False, True, True, False]
    assert Learner.load(tmp_path / "a/policy.npz").updates == 2
    refused(TrainingError, "it lacks psnr", log_of, tmp_path / "b", run_of(None))
    assert not (tmp_path / "b/training.json").exists()


def test_the_command_from_a_scenario_to_a_policy_that_decides(tmp_path: Path, capsys):
    (tmp_path / "small.yaml").write_text(yaml.safe_dump(RAW))
    asked = "--kind threshold --omegas 50,200 --episodes 2 --size 24 --jobs 1"
    out = tmp_path / "out"
    words = [str(tmp_path / "small.yaml"), *asked.split(), "--out", str(out)]
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "2/2 episodes" in text and "rewarded from cam00\n" in text
    # The scenario asks for no LPIPS, so that the reward has no such term, wherever weights lie about.
    assert "term_lpips" not in next(csv.DictReader((out / "training.csv").open()))
    make_policy(f"bandit:{out / 'policy.npz'}", None, np.random.default_rng(0))
    before = (out / "training.csv").read_text()
    assert main(words) == 0  # finished: nothing is left to be trained
    assert (out / "training.csv").read_text() == before
    assert "other settings" in refusal(capsys, main, *words[:3], *words[5:]) and (out / "policy.npz").exists()
    assert main([*words, "--parts", "pose,age"]) == 0  # the same parts
    assert "expected 0 or more, got -1" in refusal(capsys, main, *words, "--price=-1")


@pytest.mark.stability
def test_a_still_scene_has_no_moving_pixels_and_training_says_so(tmp_path):
    still = setting()
    source = {**still.scenario.source, "speed_m_per_s": 0.0}
    still = dataclasses.replace(still, scenario=dataclasses.replace(still.scenario, source=source))
    of_motion = dataclasses.replace(CONFIG, reward=make_reward("set", fidelity="moving", distance=0.0))
    refused(TrainingError, r"psnr_moving: nothing moves.*--on whole", trained, tmp_path, still, of_motion)
    learner = trained(tmp_path / "whole", still)
    assert all(np.isfinite(w).all() for w in learner.actor.weights.values())
    assert all(row["reward"] is not None for row in read_log(tmp_path / "whole"))


def outcome(psnr_db: float | None) -> dict[str, Outcome]:
    return {"cam00": Outcome(psnr_db, *[None] * 4, views=1.0, wait_ms=0.0)}


def table_of(found: Evaluation) -> SeedTable:
    return SeedTable(found.rows(Reward("psnr", psnr=1.0, ssim=0.0, distance=0.0), ["cam00"]))


def test_a_seed_that_lacks_a_value_is_not_counted_and_a_decision_that_nobody_has_one_for_is_left_out_for_all():
    rng, names = np.random.default_rng(0), ("random", "learned")
    fits = [{at: [outcome(20.0 + rng.normal()) for _ in range(2)] for at in np.ndindex(6, 4)} for _ in names]
    found = Evaluation([Candidate({"policy": name}, name) for name in names], fits)
    whole = table_of(found).values("reward", policy="learned")
    found.fits[-1][3, 1] = [outcome(None)] * 2
    assert table_of(found).values("reward", policy="learned")[3] is None
    for of in found.fits:
        of[3, 1] = [outcome(None)] * 2
        of |= {(4, n): [outcome(None)] * 2 for n in range(4)}
    mine = table_of(found).values("reward", policy="learned")
    expected = [fit["cam00"].psnr_db for n in (0, 2, 3) for fit in found.fits[-1][3, n]]
    assert mine[3] == pytest.approx(np.mean(expected)) and mine[4] is None and mine[5] == whole[5]
