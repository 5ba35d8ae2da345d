"""Studies of what learns, run whole on a small world: tables, figures, verdicts, resuming."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.studies import command
from edge_server.experiments.studies.command import LEARNING, STUDIES, make_study
from edge_server.experiments.studies.learning import (
    channel_drift,
    ppo_select,
    ppo_wait,
    reward_weights,
    semantics,
    setup,
    state_ablation,
    workshop,
)
from edge_server.experiments.studies.learning.setup import better, no_worse
from edge_server.experiments.studies.study import DOES_NOT_HOLD, HOLDS, UNDECIDED, StudyRequest, Verdict
from edge_server.experiments.training.scheduler.choices import named
from edge_server.experiments.training.scheduler.episode import Outcome
from edge_server.experiments.training.scheduler.evaluation import Evaluation, evaluate_policies
from edge_server.experiments.training.scheduler.report import percent
from edge_server.experiments.training.scheduler.setting import seeds
from edge_server.experiments.training.scheduler.workers import WorkerPool
from edge_server.scheduler.learned.rewards import Reward, make_reward
from tests.edge_server.experiments.training.scheduler.small import FIELD, reported

SMALL = {"steps": 3, "decisions": 1, "lead_ms": 1000.0, "span_ms": 400.0}


@pytest.fixture
def small(monkeypatch):
    """Every setting small, every training short; what is asked of them stays as it is."""
    usual = setup.room

    def room(*args, **more):
        return usual(*args, **{**more, **SMALL})

    monkeypatch.setattr(setup, "SIZE", 24)
    monkeypatch.setitem(setup.RUNS, True, 2)
    monkeypatch.setattr(setup, "FIELD_OPTIONS", FIELD)
    for name in LEARNING:
        module = f"edge_server.experiments.studies.{STUDIES[name][0]}"
        if name != "semantics":
            monkeypatch.setattr(f"{module}.room", room)
        monkeypatch.setattr(f"{module}.EPISODES", {True: 3, False: 3})
    monkeypatch.setattr(workshop, "room", room)
    monkeypatch.setattr(channel_drift, "BEFORE", 2)
    monkeypatch.setattr(channel_drift, "AFTER", 22)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNING)
def test_a_study_runs_to_its_verdicts_and_goes_on_from_what_it_has(name, small, tmp_path: Path, capsys):
    cases = ("priced",) if name == "ppo-select" else ()  # one of its five
    request = StudyRequest(True, tmp_path, Folders(), seeds=2, cases=cases)
    study = make_study(name)
    assert study.points(request) == []
    first = study.report(request, None)
    assert first and all(v.line() for v in first)
    rows = list(csv.DictReader((tmp_path / f"{name}.csv").open()))
    assert rows and all(row["reward"] for row in rows)
    assert list(tmp_path.glob(f"{name}*.png"))
    lines = (tmp_path / "training/evaluations.jsonl").read_text().count("\n")
    again = make_study(name).report(request, None)
    assert [(v.about, v.claim, v.verdict) for v in again] == [(v.about, v.claim, v.verdict) for v in first]
    assert (tmp_path / "training/evaluations.jsonl").read_text().count("\n") == lines
    capsys.readouterr()


@pytest.mark.slow
def test_one_case_of_a_study_is_run_with_as_many_episodes_as_asked_for(small, tmp_path: Path):
    request = StudyRequest(True, tmp_path, Folders(), seeds=2, cases=("ch6, age -0.003",), episodes=4)
    verdicts = make_study("ppo-wait").report(request, None)
    assert all(v.about.startswith("room, ch6, age -0.003/ms") for v in verdicts)
    logs = list((tmp_path / "training").glob("ppo-wait-ch6-0.003-*/training.jsonl"))
    assert [json.loads(log.read_text().splitlines()[-1])["episodes"] for log in logs] == [4] * 4


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["ppo-wait", "--case", "ch7"], ("none has 'ch7' in its name", "ch6-slow, age -0.015/ms")),
        (["mat", "--case", "room"], ("--case is for ppo-select",)),
        (["mat", "--episodes", "3"], ("--episodes is for ppo-select",)),
        (["ppo-wait", "--episodes", "0"], ("--episodes: expected 1",)),
    ],
)
def test_a_case_that_there_is_not_is_refused_with_those_there_are(words, said, tmp_path: Path, capsys):
    assert command.main([*words, "--quick", "--out", str(tmp_path)]) == 2
    text = capsys.readouterr().err
    assert all(part in text for part in said)


def evaluation_of(levels: dict[str, float], seeds: int = 12) -> Evaluation:
    """Every policy earns its level at every decision, but for what the seed does to all and a little luck."""
    rng = np.random.default_rng(1)
    asked = [(seed, n) for seed in range(seeds) for n in range(2)]
    shared = {seed: rng.normal() for seed in range(seeds)}
    found = Evaluation(Reward("psnr", psnr=1.0, ssim=0.0, distance=0.0))
    for into in (found.outcomes, found.repeated):
        for name, level in levels.items():
            psnr = {at: level + shared[at[0]] + 0.01 * rng.normal() for at in asked}
            into[name] = {at: Outcome(v, *[None] * 4, 50.0, 3.0, 0.0) for at, v in psnr.items()}
    return found


def runs(name: str, level: float, count: int = 3) -> dict[str, float]:
    return {f"{name}-{run}": level + 0.01 * run for run in range(count)}


FIXED = {"random": 0.0, "all": 0.5, "threshold:40": 0.4, "threshold:80": 0.6, "wait:0": 0.4, "wait:60": 0.6}


def answers(verdicts: Sequence[Verdict], *words: str) -> set[str]:
    """What the verdicts say whose claim has one of the words; of all without words."""
    found = {v.verdict for v in verdicts if not words or any(word in v.claim for word in words)}
    assert found
    return found


WON = "differs between decisions"  # nothing does, here: levels do not depend on decisions


@pytest.mark.parametrize(("level", "said"), [(3.0, HOLDS), (-3.0, DOES_NOT_HOLD)])
def test_select_holds_if_and_only_if_what_was_learnt_is_better(level, said):
    found = evaluation_of({**FIXED, "nearest:6": 0.3, **runs("learnt", level)})
    verdicts = ppo_select.judge("here", found)
    assert answers([v for v in verdicts if WON not in v.claim]) == {said}
    assert answers(verdicts, WON).isdisjoint({HOLDS})
    assert answers(ppo_select._as_rewarded("here", found)) == {said}
    assert any("not over trainings" in v.found for v in verdicts)


@pytest.mark.parametrize("channel", ["swing", "ch6"])
@pytest.mark.parametrize(("level", "said"), [(3.0, HOLDS), (-3.0, DOES_NOT_HOLD)])
def test_wait_holds_if_and_only_if_what_was_learnt_is_better(channel, level, said):
    both = {**runs("learnt-wait", level + 0.2), **runs("learnt-threshold", level)}
    verdicts = ppo_wait.judge(channel, channel, evaluation_of({**FIXED, **both}))
    assert answers(verdicts, "best fixed omega", "uniformly random") == {said}
    assert answers(verdicts, "waiting beats thresholds") == {HOLDS}
    assert answers(verdicts, WON).isdisjoint({HOLDS})
    turned = {**runs("learnt-wait", level), **runs("learnt-threshold", level + 0.2)}
    verdicts = ppo_wait.judge(channel, channel, evaluation_of({**FIXED, **turned}))
    assert answers(verdicts, "waiting beats thresholds") == {DOES_NOT_HOLD}


def test_cases_of_waiting_are_told_apart_by_their_names():
    names = [ppo_wait.named(*case) for case in ppo_wait.CASES]
    assert len(set(names)) == len(names)
    assert [n for n in names if n.startswith("swing, age -0.003")] == ["swing, age -0.003/ms"]
    assert "swing, where it moves, age -0.003/ms" in names


@pytest.mark.parametrize(("step", "said"), [(0.5, HOLDS), (-0.5, DOES_NOT_HOLD)])
def test_ablation_holds_if_and_only_if_more_of_the_state_is_better(step, said):
    levels: dict[str, float] = dict(FIXED)
    for k, name in enumerate(state_ablation.VARIANTS):
        levels |= runs(f"learnt {name}", 3.0 + step * k)
    verdicts = state_ablation.judge(evaluation_of(levels), list(state_ablation.VARIANTS))
    assert answers(verdicts, "best fixed threshold") == {HOLDS}
    assert answers(verdicts, "age alone", "semantics add") == {said}
    levels |= runs("learnt age", -3.0)
    verdicts = state_ablation.judge(evaluation_of(levels), list(state_ablation.VARIANTS))
    assert [v.verdict for v in verdicts if "best fixed" in v.claim] == [DOES_NOT_HOLD, HOLDS, HOLDS, HOLDS]


@pytest.mark.parametrize(("step", "said"), [(-0.5, HOLDS), (0.5, DOES_NOT_HOLD)])
def test_chapter_6_holds_if_and_only_if_the_whole_state_and_arrivals_are_better(step, said):
    levels: dict[str, float] = {**FIXED, "wait-arrived:20": 0.6 - step, "wait-arrived:60": 0.1 - step}
    for k, name in enumerate(state_ablation.LEFT_OUT):
        for kind in state_ablation.KINDS:
            level = 3.0 + step * k - (step if kind == "wait-arrived" else 0.0)
            levels |= runs(state_ablation.learnt(kind, name), level)
    verdicts = state_ablation.judge_chapter_6(evaluation_of(levels), list(state_ablation.LEFT_OUT))
    assert len(verdicts) == 3 * 7 + 2
    assert answers(verdicts, "best fixed omega") == {HOLDS}
    assert answers(verdicts, "better by Z, age, pose than", "arrive while it waits") == {said}


@pytest.mark.parametrize(("gap", "said"), [(0.5, HOLDS), (-0.5, DOES_NOT_HOLD)])
def test_a_flush_holds_if_and_only_if_it_serves_better_learnt_and_fixed(gap, said):
    kept: dict[str, float] = {**FIXED, **runs(state_ablation.learnt("wait", state_ablation.WHOLE), 3.0)}
    flushed = {**kept, **{name: level + gap for name, level in kept.items()}}
    for name in list(state_ablation.LEFT_OUT)[1:]:
        flushed |= runs(state_ablation.learnt("wait", name), 2.0)
    verdicts = state_ablation.judge_flushed(evaluation_of(flushed), evaluation_of(kept), list(state_ablation.LEFT_OUT))
    assert len(verdicts) == 7 + 2 and answers(verdicts, "a flush before") == {said}
    assert answers(verdicts, "better by Z, age, pose than") == {HOLDS}


@pytest.mark.parametrize(("gap", "said"), [(0.5, HOLDS), (-0.5, DOES_NOT_HOLD)])
def test_semantics_hold_if_and_only_if_who_looks_does_better(gap, said):
    found = evaluation_of({**FIXED, **runs("with", 3.0 + gap), **runs("without", 3.0)})
    for moves in (True, False):
        helps, *fixed = semantics.judge("x", found, moves)
        assert helps.verdict == said and answers(fixed) == {HOLDS}
    low = evaluation_of({**FIXED, "freshest-k:6": 9.0, **runs("with", 3.0 + gap), **runs("without", 3.0)})
    assert answers(semantics.judge("x", low, True)[1:]) == {DOES_NOT_HOLD}


@pytest.mark.parametrize(("gap", "said"), [(1.0, HOLDS), (-1.0, DOES_NOT_HOLD)])
def test_weights_matter_if_and_only_if_other_weights_teach_worse(gap, said):
    levels = {**FIXED, **runs("learnt a", 3.0), **runs("learnt b", 3.0 - gap)}
    better_than_fixed, matters = reward_weights.judge(evaluation_of(levels), "a", ["a", "b"])
    assert (better_than_fixed.verdict, matters.verdict) == (HOLDS, said)
    low = evaluation_of({**FIXED, **runs("learnt a", -3.0), **runs("learnt b", 0.0)})
    assert reward_weights.judge(low, "a", ["a", "b"])[0].verdict == DOES_NOT_HOLD


def drifting(learnt: float, there: float, count: int = 3) -> list[list[dict[str, list[float]]]]:
    """Runs of trainings in which the learnt policy earns 1 before the change and 0 after it."""
    rng = np.random.default_rng(2)
    before, after = channel_drift.BEFORE * 4, channel_drift.AFTER * 4
    late = {"fixed": 0.1, "learnt": learnt, "learnt afterwards": there}

    def run() -> dict[str, list[float]]:
        return {
            name: [*(1.0 + 0.01 * rng.normal(size=before)), *(level + 0.01 * rng.normal(size=after))]
            for name, level in late.items()
        }

    return [[run() for _ in range(count)] for _ in range(3)]


@pytest.mark.parametrize(("learnt", "said"), [(0.5, HOLDS), (-0.5, DOES_NOT_HOLD)])
def test_drift_holds_if_and_only_if_what_was_learnt_is_better(learnt, said):
    found = channel_drift.judge("here", drifting(learnt, 1.0))
    assert [v.verdict for v in found] == [said, HOLDS]
    assert channel_drift.judge("here", drifting(learnt, -1.0))[1].verdict == DOES_NOT_HOLD


def test_where_a_camera_dies_the_policy_learnt_afterwards_is_another_one():
    for name, change in channel_drift.changes().items():
        before, after = change.settings()
        assert before.key != after.key, name
        assert change.gone is None or (change.gone in after.silent and change.gone in after.scenario.training)


def test_what_is_learnt_of_a_change_is_a_set_of_views_where_they_cost_something(tmp_path: Path):
    with setup.StudyTrainer(StudyRequest(True, tmp_path, Folders(), episodes=7)) as trainer:
        configs = {name: change.config(trainer, 2) for name, change in channel_drift.changes().items()}
    priced = [name for name, config in configs.items() if config.reward.views < 0]
    assert [configs[name].spec.action for name in priced] == ["select"]
    assert {config.spec.action for name, config in configs.items() if name not in priced} == {"threshold"}
    assert {(config.episodes, config.seed) for config in configs.values()} == {(7, 2)}


def test_a_study_is_judged_by_cameras_that_neither_reward_nor_train(tmp_path: Path):
    usual = setup.room()
    assert usual.report == setup.REPORT and set(usual.report).isdisjoint(usual.rewarding)
    assert set(usual.report).isdisjoint(usual.scenario.training)
    assert set(setup.FOUR_VIEWPOINTS).isdisjoint(setup.REPORT)
    reward, candidates = make_reward("set", distance=0.0), {"all": named("all"), "random": named("random")}
    with setup.StudyTrainer(StudyRequest(True, tmp_path, Folders())) as trainer:
        found = trainer.evaluate(reported(), candidates, reward, 2)
        same = trainer.evaluate_as_rewarded(reported(), candidates, reward, 2)
    with WorkerPool(Folders()) as pool:
        expected = evaluate_policies(reported().judged, pool, seeds(0, "test", 2), candidates, reward)
    assert found.outcomes == expected.outcomes and found.repeated == expected.repeated
    assert found.outcomes["all"] != same.outcomes["all"]


def test_the_spread_of_repeated_trainings_is_part_of_an_interval():
    base = {s: 0.01 * (s % 3) for s in range(40)}
    alike = [{s: v + 0.2 + 0.01 * (-1) ** (s + r) for s, v in base.items()} for r in range(3)]
    unlike = [{s: v + level for s, v in base.items()} for level in (0.7, 0.2, -0.3)]
    assert better("a", "b", alike, base).verdict == HOLDS
    # The mean is the same 0.2, and hardly differs between seeds; another training may come to anything.
    assert better("a", "b", unlike, base).verdict == UNDECIDED
    assert better("a", "b", setup.mean_of(unlike), base).verdict == HOLDS
    assert "3 trainings and 40 seeds" in better("a", "b", alike, base).found
    assert "of a single training" in better("a", "b", alike[0], base).found
    assert setup.paired_difference(unlike, unlike).mean == 0.0
    assert setup.RUNS[False] >= 3


def test_verdicts_follow_from_the_paired_differences():
    base = {s: 1.0 + 0.1 * s for s in range(8)}
    up, down = ({s: v + d + 0.001 * (s % 3) for s, v in base.items()} for d in (0.2, -0.2))
    same = {s: v + 0.001 * (-1) ** s for s, v in base.items()}
    assert [better("a", "b", x, base).verdict for x in (up, down, same)] == ["holds", "does not hold", "undecided"]
    evaluation = evaluation_of({"random": 0.5, "all": 1.5})
    assert [no_worse("a", "b", x, base, evaluation).verdict for x in (up, down, same)] == [
        "holds",
        "does not hold",
        "holds",
    ]
    assert "-20 % of the way from random to hindsight" in no_worse("a", "b", down, base, evaluation).found
    # A hundredth of next to nothing is no limit.
    near_zero = {s: 0.01 * (-1) ** s for s in base}
    found = no_worse("a", "b", near_zero, near_zero, evaluation)
    assert found.verdict == UNDECIDED and "too near zero" in found.found
    # Who does the same at every decision is no better, and that is known.
    alike = better("a", "b", [base, base], base)
    assert alike.verdict == DOES_NOT_HOLD and "the very same" in alike.found
    assert better("a", "b", {}, base).verdict == UNDECIDED


@pytest.mark.parametrize(
    ("mine", "base", "text"),
    [
        (1.2, 1.0, "+20.0 %"),
        (-0.8, -1.0, "+20.0 %"),
        (0.5, 0.001, "no percentage"),  # whose own interval has the zero in it
        (0.1, -1.7, "no percentage"),
        (0.5, 0.0, "no percentage"),
    ],
)
def test_a_percentage_is_told_only_where_the_rewards_zero_is_far_away(mine, base, text):
    values = {s: base + 0.01 * (-1) ** s for s in range(10)}
    assert percent(dict.fromkeys(values, mine), values).startswith(text)


@pytest.mark.parametrize(("jobs", "said"), [(1, UNDECIDED), (2, HOLDS), (8, UNDECIDED)])
def test_only_two_processes_tell_how_long_two_cores_take(jobs, said, tmp_path: Path):
    rows = [{"fits": 100, "carried_out": 100, "decisions": 50}]
    found = ppo_select._time("x", [setup.TrainedPolicy(None, None, rows, 10.0, jobs, tmp_path)])  # type: ignore[arg-type]
    assert found.verdict == said
