"""Training: independent of the processes, continued bit for bit after a stop, and it learns."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from edge_server.config import ComputeConfig
from edge_server.experiments.common.statistics import paired
from edge_server.experiments.training.scheduler import command, policy_comparison
from edge_server.experiments.training.scheduler.choices import choices, named
from edge_server.experiments.training.scheduler.command import main
from edge_server.experiments.training.scheduler.deployed import Decided, _run, sibling_advantages
from edge_server.experiments.training.scheduler.episode import Choice, EpisodeFactory, Outcome
from edge_server.experiments.training.scheduler.evaluation import HINDSIGHT, baseline_policies, evaluate_policies, rows
from edge_server.experiments.training.scheduler.fit_problem import KEPT, FitProblem
from edge_server.experiments.training.scheduler.report import draw_curve, lines, summary
from edge_server.experiments.training.scheduler.setting import Setting, reward_of, seeds
from edge_server.experiments.training.scheduler.trainer import (
    TrainingConfig,
    TrainingError,
    read_log,
    subtract_sibling_baseline,
    train,
)
from edge_server.experiments.training.scheduler.workers import WorkerPool
from edge_server.scheduler import make_policy
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.decision import Decision
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import Reward, make_reward
from edge_server.scheduler.learned.state import State, StateLayout
from freshfield.files import write_csv
from tests.edge_server.experiments.training.scheduler.small import NOTHING, RAW, setting
from tests.edge_server.scheduler.learned.problems import collect

REWARD = make_reward("set", distance=0.0)
CONFIG = TrainingConfig(
    Spec("select", StateLayout(("age", "pose")), hidden=16), REWARD, episodes=6, batch=2, checkpoint_every=1
)


def weights(learner: Learner) -> dict[str, np.ndarray]:
    return learner.actor.weights


def same(a: Learner, b: Learner) -> bool:
    return all(np.array_equal(w, weights(b)[name]) for name, w in weights(a).items())


def quiet(line: str) -> None:
    del line


@pytest.fixture
def pool() -> Iterator[WorkerPool]:
    with WorkerPool(NOTHING) as pool:
        yield pool


def trained(out: Path, of: Setting | None = None, say=quiet) -> Learner:
    """What a pool of its own trains."""
    with WorkerPool(NOTHING) as pool:
        return train(of or setting(), CONFIG, pool, out, say)


def command_line(folder: Path, words: str, raw: dict = RAW) -> tuple[list[str], Path]:
    """The words of a training of a small scenario, and its --out."""
    (folder / "small.yaml").write_text(yaml.safe_dump(raw))
    out = folder / "out"
    return [str(folder / "small.yaml"), *words.split(), "--jobs", "1", "--out", str(out)], out


def asked_of(pool: WorkerPool, numbers: Iterable[int] = (7,)) -> list[tuple[int, int, Choice]]:
    """Every decision of these episodes with the choice of policy ``all``, to be evaluated."""
    moments = [m for episode in pool.draw(setting(), list(numbers)) for m in episode]
    return [(m.seed, m.number, c) for m in moments for c in choices(named("all"), [m])]


def test_the_same_weights_from_one_process_and_from_two(tmp_path: Path, pool: WorkerPool):
    alone = train(setting(), CONFIG, pool, tmp_path / "one", quiet)
    with WorkerPool(NOTHING, jobs=2) as two:
        both = train(setting(), CONFIG, two, tmp_path / "two", quiet)
    assert same(alone, both) and not same(alone, Learner(CONFIG.spec, CONFIG.seed))
    timeless = [
        [{k: v for k, v in row.items() if "seconds" not in k} for row in read_log(tmp_path / name)]
        for name in ("one", "two")
    ]
    assert timeless[0] == timeless[1]
    other = train(setting(), dataclasses.replace(CONFIG, seed=1), pool, tmp_path / "other", quiet)
    assert not same(alone, other)


def test_a_stopped_training_continues_bit_for_bit(tmp_path: Path):
    def stop(line: str) -> None:
        if line.startswith("4/6"):
            raise KeyboardInterrupt

    whole = trained(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        trained(tmp_path / "parts", say=stop)
    assert len(read_log(tmp_path / "parts")) == 2 and not (tmp_path / "parts/policy.npz").exists()
    parts = trained(tmp_path / "parts")
    assert same(whole, parts) and (tmp_path / "parts/policy.npz").exists()
    assert len(list((tmp_path / "parts").glob("weights-*.npz"))) == 1
    with pytest.raises(TrainingError, match="other settings"):
        trained(tmp_path / "parts", setting(steps=5))


@pytest.mark.parametrize("damage", ["weights-*.npz", "training.jsonl"])
@pytest.mark.parametrize("what", ["gone", "half"])
def test_a_training_with_damaged_files_is_refused_in_one_line(damage: str, what: str, tmp_path: Path):
    trained(tmp_path)
    (path,) = tmp_path.glob(damage)
    if what == "gone":
        path.unlink()
    else:
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(TrainingError, match="choose another --out, or delete it"):
        trained(tmp_path)


def test_it_learns_to_use_fresh_views_where_only_age_counts(tmp_path: Path, pool: WorkerPool):
    omegas = (30.0, 100.0, 400.0)
    spec = Spec("threshold", StateLayout(("age",)), omegas, hidden=16, learning_rate=1e-2)
    config = TrainingConfig(spec, Reward("age", 0.0, 0.0, 0.0, age=-0.01), episodes=60, batch=6)
    learner = train(setting(steps=1), config, pool, tmp_path, quiet)
    candidates = {**baseline_policies(omegas, ["threshold"]), "learnt": learner.actor}
    evaluation = evaluate_policies(setting(steps=1), pool, seeds(0, "test", 6), candidates, config.reward)
    assert evaluation.term("learnt", "aaoi_ms").mean < evaluation.term("threshold:100", "aaoi_ms").mean
    assert paired(evaluation.rewards("learnt"), evaluation.rewards("random")).low > 0.0
    found = read_log(tmp_path)
    assert found[-1]["omega_ms"] < 60.0 < found[0]["omega_ms"]


def test_evaluations_are_kept_in_a_file_and_a_torn_line_costs_only_itself(tmp_path: Path):
    known = tmp_path / "known.jsonl"
    with WorkerPool(NOTHING, known=known) as pool:
        asked = asked_of(pool)
        first = pool.evaluate(setting(), asked * 2)
        assert pool.evaluated == len(asked) and first[: len(asked)] == first[len(asked) :]
        assert pool.evaluate(setting(steps=5), asked) != first[: len(asked)]
    text = known.read_text()
    known.write_text(text + text.splitlines()[0][:20])
    with WorkerPool(NOTHING, known=known) as pool:
        assert pool.evaluate(setting(), asked) == first[: len(asked)] and pool.evaluated == 0


def test_the_sibling_baseline_is_the_mean_of_the_other_tries():
    found = subtract_sibling_baseline(np.array([1.0, 2.0, 6.0, 5.0, np.nan, 1.0]), 3)
    assert np.allclose(found, [1 - 4, 2 - 3.5, 6 - 1.5, 4.0, np.nan, -4.0], equal_nan=True)
    alone = subtract_sibling_baseline(np.array([3.0, np.nan]), 2)
    assert np.isnan(alone).all()  # nothing to compare with
    assert subtract_sibling_baseline(np.array([3.0, 4.0]), 1).tolist() == [3.0, 4.0]


@pytest.fixture(scope="module")
def evaluation(tmp_path_factory):
    names = baseline_policies((40.0, 120.0), ["threshold"], ("random", "all"))
    with WorkerPool(NOTHING) as pool:
        actor = Learner(CONFIG.spec, 0).actor
        return evaluate_policies(setting(), pool, seeds(0, "test", 6), {**names, "learnt": actor}, REWARD)


def test_shares_run_from_random_to_hindsight(evaluation):
    assert evaluation.best_fixed("threshold")[1] in evaluation.outcomes
    assert evaluation.share(evaluation.rewards("random")).mean == 0.0
    assert evaluation.share(evaluation.rewards(HINDSIGHT)).mean == 1.0
    assert set(evaluation.rewards(HINDSIGHT)) == {seed for seed, _ in evaluation.outcomes["all"]}


def test_an_evaluation_is_reported_as_table_and_text(evaluation, tmp_path: Path):
    write_csv(tmp_path / "evaluation.csv", rows(evaluation))
    found = {row["policy"]: row for row in csv.DictReader((tmp_path / "evaluation.csv").open())}
    assert found.keys() == {*evaluation.outcomes, HINDSIGHT}
    assert float(found["all"]["views"]) >= 3.0 and float(found["random"]["share"]) == 0.0
    text = " ".join(lines(evaluation, "learnt", "threshold"))
    assert "over random" in text and "threshold:" in text
    kept = json.loads(json.dumps(summary(evaluation, "learnt", "threshold")))
    assert kept["seeds"] == 6 and len(kept["over_best_fixed"]) == 3


def test_the_curve_is_drawn_with_gaps(tmp_path: Path):
    config = [
        {"episodes": 10 * k, "reward": None if k == 2 else 0.1 * k, "term_psnr": 0.3, "term_age": None}
        for k in range(5)
    ]
    draw_curve(tmp_path / "curve.png", config, {"random": 0.1})
    assert (tmp_path / "curve.png").stat().st_size > 5_000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["nowhere"], "shipped scenarios"),
        (["room", "--parts", "age,smell"], "no smell"),
        (["room", "--jobs", "0"], "--jobs"),
        (["room", "--episodes", "0"], "episodes"),
        (["lego", "--jobs", "1"], "lego"),
        (["room", "--field", "nope"], "--field: expected one of ngp"),
        (["room", "--omegas", "20,60"], "--kind select chooses cameras"),
        (["room", "--kind", "wait", "--omegas", "20,soon"], "expected milliseconds such as"),
        (["room", "--report", "cam77"], "cam77 is not one of"),
        (["room", "--report", "cam00"], "left to reward"),
        (["room", "--network", "flat"], "--report none"),
        (["room", "--price", "-1"], "--price: expected 0 or more"),
        (["room", "--fit-steps", "0"], "expected at least 1"),
    ],
)
def test_what_cannot_be_trained_is_refused_in_one_line(words, said, tmp_path: Path, capsys, monkeypatch):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    text = capsys.readouterr().err
    assert said in text and text.count("\n") == 1


def test_other_learners_see_the_same_decisions_as_a_problem(pool: WorkerPool):
    problem = FitProblem(setting(), CONFIG.spec, REWARD, pool)
    moments = pool.draw(setting(), [4])[0]
    decision = problem.draw(4 * setting().decisions + 1)
    assert decision.moment == moments[1] and decision.state is moments[1].state
    action = np.array([True, False, True, True])
    reward, terms = decision.reward(action)
    assert decision.reward(action) == (reward, terms) and set(terms) == {"psnr", "ssim"}
    assert reward == pytest.approx(sum(terms.values()))
    batch = collect(Learner(CONFIG.spec, 0), problem, range(6))
    assert len(batch) == 6 and np.isfinite(batch.rewards).all()


def test_the_command_from_a_scenario_to_a_policy_that_decides(tmp_path: Path, capsys):
    asked = "--kind threshold --omegas 50,200 --episodes 2 --batch 1 --decisions 1 --fit-steps 2 --size 24"
    words, out = command_line(tmp_path, f"{asked} --test 2")
    assert main(words) == 0
    text = capsys.readouterr().out
    assert "2/2 episodes" in text and "over random" in text and "bandit:" in text
    assert "rewarded from cam00; judged from cam03" in text
    kept = json.loads((out / "summary.json").read_text())
    assert kept["reward_name"] == "corrected" and kept["best_fixed"].startswith("threshold:")
    assert (kept["rewarded_from"], kept["judged_from"], kept["motions"]) == (["cam00"], ["cam03"], True)
    # The scenario asks for no LPIPS, so that the reward has no such term, wherever weights lie about.
    learner = Learner.load(out / "policy.npz")
    assert learner.reward_fields["name"] == "corrected" and learner.reward_fields["distance"] == 0.0
    for name in ("training.csv", "training.png", "evaluation.csv", "policy.npz"):
        assert (out / name).stat().st_size > 0
    policy = make_policy(f"bandit:{out / 'policy.npz'}", None, np.random.default_rng(0))
    with WorkerPool(NOTHING) as pool:
        chosen = choices(lambda rng: policy, pool.draw(setting(), [1])[0])
    assert all(choice.cameras for choice in chosen)
    lines_before = (out / "evaluations.jsonl").read_text()
    assert main(words) == 0  # finished: nothing is left to be evaluated
    assert (out / "evaluations.jsonl").read_text() == lines_before
    # What the training took is what it took in all, not what its last session did.
    assert json.loads((out / "summary.json").read_text())["seconds"] == kept["seconds"] > 0.0
    # What is refused costs nothing that was there.
    assert main([*words[:3], *words[5:]]) == 2 and "other settings" in capsys.readouterr().err
    assert json.loads((out / "summary.json").read_text())["best_fixed"] == kept["best_fixed"]
    assert (out / "evaluation.csv").exists() and (out / "policy.npz").exists()
    assert main([*words[:-3], "1", "--test", "0", "--out", str(out)]) == 0
    assert not (out / "summary.json").exists() and not (out / "evaluation.csv").exists()


@pytest.mark.slow  # some 6 s of virtual deployments
def test_a_scheduler_that_decides_itself_is_rewarded_by_what_is_shown_and_scored_beside_fixed_ones(
    tmp_path: Path, capsys, monkeypatch
):
    monkeypatch.setattr(policy_comparison, "POLICIES", ("all", "learnt", "age-driven"))
    monkeypatch.setattr(policy_comparison, "SPAN_MS", 600.0)
    for module in (command, policy_comparison):
        monkeypatch.setattr(module, "LEAD_MS", 1200.0)
    costs = {"ms_per_step": 2.0, "ms_per_view": 1.0}
    edge = {**RAW["edge"], "steps": 3, "compute": costs, "updates": "arrivals", "update_ms": 20}
    asked = "--kind threshold --hold 200 --omegas 50,200 --episodes 2 --batch 1 --decisions 3 --size 0 --test 1"
    words, out = command_line(tmp_path, asked, {**RAW, "channel": {"preset": "swing"}, "edge": edge})
    assert main(words) == 0
    assert "rewarded from cam03; judged from cam00" in capsys.readouterr().out
    # Two tries of three decisions, once frames are there.
    assert all(4 <= row["decisions"] <= 6 for row in read_log(out))
    scores = json.loads((out / "scores.json").read_text())
    found = scores["policies"]
    assert scores["seed"] == RAW["seed"] and scores["compute"]["ms_per_view"] == 1.0
    assert found["all"]["psnr_db_over_all"][0] == 0.0 and found["learnt"]["own_seed"]["psnr_db"] > 5.0
    assert found["age-driven"]["own_seed"]["views"] < found["all"]["own_seed"]["views"] == 4.0
    assert set(found["learnt"]["own_seed"]["omega_ms"]) <= {"low", "high"}
    before = (out / "runs.jsonl").read_text()
    assert main(words) == 0  # finished: nothing is run again
    assert (out / "runs.jsonl").read_text() == before
    assert json.loads((out / "scores.json").read_text())["policies"] == found
    actor = Actor.load(out / "actor.npz")
    assert actor.spec.hold_ms == 200.0 and (out / "actor.npz").stat().st_size < 4e5
    compared = tmp_path / "policies.json"
    policy_comparison.main(
        [
            words[0],
            "all",
            "aoii:2",
            "covariance:2",
            "--seeds",
            "2",
            "--seconds",
            "0.6",
            "--slower",
            "3",
            "--json",
            str(compared),
        ]
    )
    found = json.loads(compared.read_text())
    assert (found["compute"]["ms_per_step"], found["compute"]["ms_per_view"]) == (6.0, 3.0)
    shown = found["policies"]
    assert shown["all"]["psnr_db_over_all"] == [0.0, 0.0, 0.0] and shown["all"]["views"][0] > 3.0
    for name in ("aoii:2", "covariance:2"):
        assert shown[name]["views"][0] == 2.0 and shown[name]["psnr_db"][0] > 5.0
    with pytest.raises(SystemExit):
        policy_comparison.main([words[0], "all", "--slower", "0", "--json", str(compared)])
    assert "--slower 0: expected more than 0" in capsys.readouterr().err


def test_a_running_deployment_decides_as_often_as_an_update_lasts_and_takes_in_what_it_has_time_for():
    """As ``edge-server simulate`` does where updates follow arrivals."""
    costs = ComputeConfig(ms_per_step=2.0, ms_per_view=1.0)
    small = setting(compute=costs, lead_ms=400.0, span_ms=1200.0)
    edge = {**small.scenario.edge, "updates": "arrivals", "update_ms": 50.0, "steps": 2, "grace_ms": 0.0}
    small = dataclasses.replace(small, scenario=dataclasses.replace(small.scenario, edge=edge))
    deployment, _ = _run(EpisodeFactory(small, NOTHING), 5, make_policy("all", None, np.random.default_rng(0)))
    decided_ms = [p.published_ns / 1e6 - p.update_ms for p in deployment.publications]
    assert len(decided_ms) > 10 and np.median(np.diff(decided_ms)) == pytest.approx(50.0)
    assert deployment.settings.most_new == 96


def test_tries_are_compared_with_the_others_that_decided_at_the_same_time():
    def decided(*at_ms: int) -> list[Decided]:
        made = []
        for t in at_ms:
            state = State(np.zeros(1), np.zeros((1, 6)), None, np.ones(1, bool))
            decision = Decision(0, t * 1_000_000, state, np.array(0), 0.0, None)  # type: ignore[arg-type]
            made.append(Decided(decision, None, ""))  # type: ignore[arg-type]
        return made

    tries = [decided(0, 110, 205), decided(3, 120), decided(7, 299)]
    rewards = [[1.0, 2.0, 3.0], [4.0, float("nan")], [7.0, 5.0]]
    found = sibling_advantages(tries, 100.0, rewards)
    assert np.allclose(found[0], [1 - 5.5, np.nan, 3 - 5], equal_nan=True)
    assert np.allclose(found[1], [0.0, np.nan], equal_nan=True)
    assert np.allclose(found[2], [4.5, 2.0])
    assert sibling_advantages(tries[:1], 100.0, rewards[:1])[0].tolist() == [1.0, 2.0, 3.0]


class Played:
    """Plays given decisions, an episode a call."""

    def __init__(self, *episodes: list[Decided]) -> None:
        self.episodes = iter(episodes)

    def play(self, setting, seeds, actor, tries):
        return [[next(self.episodes)] for _ in seeds]


def test_only_a_first_batch_without_a_reward_ends_a_training_in_the_deployment(tmp_path: Path):
    spec = Spec("threshold", StateLayout(("age",)), (50.0, 200.0), hidden=16, hold_ms=200.0)
    config = TrainingConfig(spec, REWARD, episodes=4, batch=1, tries=1)
    state = State(np.ones(2), np.zeros((2, 6)), None, np.ones(2, bool))

    def decided(psnr_db: float | None) -> list[Decided]:
        outcome = Outcome(psnr_db, None, 0.5, None, None, None, 2.0, 0.0)
        return [Decided(Decision(0, 0, state, np.array(k), -0.7, None), outcome, "") for k in (0, 1)]  # type: ignore[arg-type]

    def log_of(out: Path, *episodes: list[Decided]) -> list[dict]:
        train(setting(), config, Played(*episodes), out, quiet)  # type: ignore[arg-type]
        return read_log(out)

    rows = log_of(tmp_path / "a", decided(20.0), [], decided(None), decided(22.0))
    assert [row["decisions"] for row in rows] == [2, 0, 2, 2]
    assert [row["reward"] is None for row in rows] == [False, True, True, False]
    assert Learner.load(tmp_path / "a/policy.npz").updates == 2
    for first, said in (([], "nothing had arrived"), (decided(None), "it lacks psnr")):
        with pytest.raises(TrainingError, match=said):
            log_of(tmp_path / "b", first)


def test_a_policy_may_show_nothing_in_the_span(tmp_path: Path):
    shown = {"psnr_db": None, "psnr_moving_db": None, "ssim": None, "views": 0.0, "aaoi_ms": None}
    said: list[str] = []

    class Judge:
        def judge(self, setting, seeds, who):
            return [shown for _ in seeds]

    actor = Learner(CONFIG.spec, 0).actor
    found = policy_comparison.score_policies(setting(), Judge(), range(2), actor, "", tmp_path / "known", said.append)  # type: ignore[arg-type]
    assert said[0] == "all: - dB shown with seed 3"
    assert found["policies"]["learnt"]["psnr_db_over_all"] == [None] * 3


def test_a_policy_of_an_earlier_training_never_passes_for_this_ones(tmp_path: Path, pool: WorkerPool):
    Learner(CONFIG.spec, 77).save(tmp_path / "policy.npz")

    def stop(line: str) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(setting(), CONFIG, pool, tmp_path, stop)
    assert not (tmp_path / "policy.npz").exists()
    Learner(CONFIG.spec, 77).save(tmp_path / "policy.npz")
    learner = train(setting(), CONFIG, pool, tmp_path, quiet)
    assert same(Learner.load(tmp_path / "policy.npz"), learner)


@pytest.mark.parametrize(
    ("reward", "missing"),
    [(make_reward("set"), "lpips.*--distance none"), (make_reward("set", distance_is="perceptual"), "edge.metrics")],
)
def test_a_reward_that_cannot_be_had_is_refused_after_the_first_batch(reward, missing, tmp_path, pool):
    config = dataclasses.replace(CONFIG, reward=reward)
    with pytest.raises(TrainingError, match=missing):
        train(setting(), config, pool, tmp_path, quiet)
    assert not (tmp_path / "training.json").exists()


def test_the_distance_of_a_reward_follows_from_the_scenario_and_from_what_is_asked(tmp_path: Path):
    for name in ("alexnet_features.npz", "lin_alex_v0.1.npz"):
        (tmp_path / name).write_bytes(b"no weights")
    reward, missing = reward_of("set", "whole", tmp_path, "none")
    assert reward.distance == 0.0 and "edge.lpips is none" in missing
    reward, missing = reward_of("set", "whole", tmp_path, "squeeze")
    assert reward.distance == 0.0 and "squeeze" in missing
    assert reward_of("set", "whole", None, "alex", "none") == (make_reward("set", distance=0.0), None)
    stand_in, missing = reward_of("set", "moving", None, "alex", "perceptual")
    assert missing is None and stand_in == make_reward("set", "moving", distance_is="perceptual")


def test_a_stand_in_distance_is_measured_learnt_from_and_kept_for_live_use(tmp_path: Path, capsys):
    asked = "--distance perceptual --episodes 1 --batch 1 --decisions 1 --fit-steps 2 --size 24 --test 0"
    words, out = command_line(tmp_path, f"{asked} --scratch")
    assert main(words) == 0
    assert "teaches to ignore how old views are" in " ".join(capsys.readouterr().out.split())
    (row,) = read_log(out)
    assert row["term_perceptual"] == pytest.approx(-row["perceptual"])
    known = Learner.load(out / "policy.npz").reward_fields
    assert Reward(**known) == make_reward("set", distance_is="perceptual")


def test_what_is_finished_is_kept_and_told_while_more_is_carried_out(tmp_path: Path):
    known, seen = tmp_path / "known.jsonl", []

    def stop(done: int, count: int) -> None:
        seen.append((done, count))
        raise KeyboardInterrupt

    with WorkerPool(NOTHING, known=known) as pool:
        asked = asked_of(pool, range(12))
        with pytest.raises(KeyboardInterrupt):
            pool.evaluate(setting(), asked, stop)
    ((done, count),) = seen
    assert count == len(asked) == 24 and 0 < done <= 8
    assert len(known.read_text().splitlines()) == done
    with WorkerPool(NOTHING, known=known) as pool:
        pool.evaluate(setting(), asked)
        assert pool.evaluated == count - done


def test_progress_is_told_before_the_first_batch_is_over(tmp_path: Path, monkeypatch, pool: WorkerPool):
    monkeypatch.setattr("edge_server.experiments.training.scheduler.trainer._PROGRESS_EVERY_S", 0.0)
    text: list[str] = []
    config = dataclasses.replace(CONFIG, episodes=6, batch=6)
    train(setting(), config, pool, tmp_path, text.append)
    assert len(text) >= 3 and text[0].endswith("fits of batch 1") and text[-1].startswith("6/6 episodes")


def test_the_time_of_evaluations_is_that_of_when_they_were_carried_out(tmp_path: Path):
    known = tmp_path / "known.jsonl"
    with WorkerPool(NOTHING, known=known) as pool:
        asked = asked_of(pool)
        pool.evaluate(setting(), asked)
        spent = pool.cost_s(setting(), asked)
    assert spent > 0.0
    with WorkerPool(NOTHING, known=known) as pool:
        pool.evaluate(setting(), asked)
        assert pool.evaluated == 0 and pool.cost_s(setting(), asked * 2) == spent
    # What an older version kept has no time, so that it is carried out again.
    rows = [json.loads(line) for line in known.read_text().splitlines()]
    known.write_text("".join(json.dumps({k: v for k, v in r.items() if k != "cost_ms"}) + "\n" for r in rows))
    with WorkerPool(NOTHING, known=known) as pool:
        pool.evaluate(setting(), asked)
        assert pool.evaluated == len(asked)


def test_other_learners_are_never_given_an_episode_that_policies_are_tested_on():
    problem = FitProblem(setting(), CONFIG.spec, REWARD, None)
    drawn = []
    problem = dataclasses.replace(problem, pool=SeenSeeds(drawn))
    for seed in (0, 5, 2**31 - 1, 2 * 10**6 * 2 + 1, 123_456_789):
        problem.draw(seed)
    tested = {s // 10**6 for s in (seeds(0, "test", 1)[0], seeds(0, "choose", 1)[0])}
    assert not {s // 10**6 for s in drawn} & tested and set(s // 10**6 for s in drawn) == {0}
    assert drawn[2] == (2**31 - 1) // 2 % 10**6
    other = dataclasses.replace(problem, run=3)
    other.draw(8)
    assert drawn[-1] == seeds(3, "train", 1, 4)[0]


class SeenSeeds:
    """Notes which episodes are drawn, and draws nothing."""

    def __init__(self, drawn: list[int]) -> None:
        self.drawn = drawn
        self.forgotten: list[int] = []

    def draw(self, setting, seeds):
        self.drawn += seeds
        return [(None,) * setting.decisions]

    def forget(self, setting, seeds):
        self.forgotten += seeds


def test_other_learners_do_not_fill_the_memory_with_episodes():
    pool = SeenSeeds([])
    problem = FitProblem(setting(), CONFIG.spec, REWARD, pool)
    for number in (*range(2 * (KEPT + 3)), 0):
        problem.draw(number)
    kept = [seed for seed in dict.fromkeys(pool.drawn) if seed not in pool.forgotten]
    assert len(dict.fromkeys(pool.drawn)) == KEPT + 3 and len(pool.forgotten) == 4 and len(kept) == KEPT - 1
    assert seeds(0, "train", 1, 0)[0] == pool.drawn[-1] == pool.forgotten[0], "drawn, forgotten, drawn again"
