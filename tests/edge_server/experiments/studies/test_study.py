"""Studies: sound points, trials that repeat, verdicts that follow from the figures and can come out either way."""

import csv
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.common.statistics import Interval
from edge_server.experiments.studies import drawing, preferences, study, trial, viewpoints
from edge_server.experiments.studies.depth_rate import DepthRun, run_with_depth
from edge_server.experiments.studies.learned_schedulers import LEFT_OUT, WEIGHTED, WHICH_VIEWS
from edge_server.experiments.studies.learning import FOUR_VIEWPOINTS, REPORT
from edge_server.experiments.studies.registry import LEARNING, ON_A_CHANNEL, STUDIES
from edge_server.experiments.studies.study import Study, StudyError, StudyRequest
from edge_server.experiments.studies.study_command import checked, main
from edge_server.experiments.studies.study_constants import TRAININGS
from edge_server.experiments.studies.trial import Trial, run_trial
from edge_server.experiments.studies.verdicts import Claim, Finding, Verdict, interior, judge, trend
from edge_server.scheduler import make_policy
from edge_server.scheduler.learned.rewards import f_w
from edge_server.viewpoints.candidates import ViewpointError
from tests.edge_server.experiments.rollouts.small import RAW
from tests.support import refused


def judged(asked: Study, table: SeedTable) -> list[Verdict]:
    return judge(asked.claims, asked.metrics, asked.panels, table)


def request(tmp_path: Path, **more: Any) -> StudyRequest:
    return StudyRequest(True, tmp_path, Folders(), **more)


def figures(quality: float, age: float, views: float = 9.0) -> dict[str, Any]:
    return {
        "psnr_db": 20.0 + quality,
        "psnr_moving_db": 18.0 + quality,
        "ssim": 0.8 + quality / 50,
        "shown_psnr_db": 20.0 + quality,
        "shown_psnr_moving_db": 18.0 + quality,
        "lpips": 0.2 - quality / 50,
        "views": views,
        "aaoi_ms": age,
        "age_sum_ms": 18 * age,
        "wait_ms": 0.0,
    }


def noise(seed: int, value: float | None) -> float:
    return 0.05 * math.sin(12.9898 * seed + 78.233 * (value or 0.0))


def peak(at: float) -> Callable[[Any], dict[str, Any]]:
    """Best at ``at`` ms of omega; the limit is at the peak's own height."""

    def rule(trial: Any) -> dict[str, Any]:
        if trial.channel.get("preset") == "ideal":
            return figures(3.0 + noise(trial.seed, 0.0), 15.0, 18.0)
        value = trial.value if trial.value is not None else 1000.0
        return figures(2.0 - abs(math.log(value / at)) + noise(trial.seed, value), value / 2)

    return rule


def verdicts(name: str, tmp_path: Path, rule: Callable[[Any], dict[str, Any]], seeds: int = 6) -> list[Verdict]:
    """Of a study of trials on ``room`` whose results follow a rule."""
    points = STUDIES[name].cases(request(tmp_path, seeds=seeds, scenes=("room",)))
    rows = [{**p.labels, "seed": p.trial.seed, **rule(p.trial)} for p in points]
    table = SeedTable([{**row, **f_w(row)} for row in rows])
    return judged(STUDIES[name], table)


def answers(found: list[Verdict], *words: str) -> set[str]:
    """What the verdicts say that have all the words in their claim or setting."""
    said = {v.verdict for v in found if all(word in f"{v.about} {v.claim}" for word in words)}
    assert said, f"no verdict has {words} in it: {[v.about for v in found]}"
    return said


def test_every_study_has_cases_and_whole_no_fewer_than_in_a_quick_pass(tmp_path: Path):
    for name, each in STUDIES.items():
        whole, quick = (len(each.cases(StudyRequest(short, tmp_path, Folders()))) for short in (False, True))
        assert whole >= quick > 0, name


@pytest.mark.parametrize("name", ON_A_CHANNEL)
@pytest.mark.parametrize("quick", [True, False])
def test_every_point_is_a_deployment_that_can_be_read(name: str, quick: bool, tmp_path: Path):
    points = STUDIES[name].cases(StudyRequest(quick, tmp_path, Folders(), seeds=1))
    distinct = {(json.dumps(p.labels, sort_keys=True), p.trial.seed) for p in points}
    assert points and len(distinct) == len(points)
    for point in points:
        scenario = point.trial.scenario()
        assert len(scenario.training) == 18 and scenario.held_out
        make_policy(point.trial.policy, point.trial.value, scenario.rng("policy"))


@pytest.mark.slow  # some seconds of fits
def test_figure_6_3_is_made_of_ones_own_channel_and_scene(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr("edge_server.experiments.studies.waiting_curves.QUICK_OMEGAS", (60.0, 120.0, 240.0))
    scene, channel, out = tmp_path / "mine.yaml", tmp_path / "slow.yaml", tmp_path / "out"
    scene.write_text(yaml.safe_dump({**RAW, "name": "mine"}))
    channel.write_text("{service: 'det:40ms', discipline: drop-new}")
    words = ["--scene", str(scene), "--channel", str(channel), "--seeds", "1", "--jobs", "1", "--out", str(out)]
    assert main(["omega", "--quick", *words]) == 0
    assert "mine, slow, threshold" in capsys.readouterr().out
    assert {row["channel"] for row in csv.DictReader((out / "omega.csv").open())} == {"slow", ""}
    assert f"--channel {channel}" in (out / "omega.md").read_text()
    known = (out / "results/trials.jsonl").read_bytes()
    assert main(["omega", "--quick", *words]) == 0  # everything is known
    assert (out / "results/trials.jsonl").read_bytes() == known


def at_delay(peak_of):
    """A rule whose best threshold follows the mean delay as ``peak_of`` says."""

    def rule(trial):
        return peak(peak_of(trial.channel.get("service", {"mean_ms": 60.0})["mean_ms"]))(trial)

    return rule


@pytest.mark.parametrize(
    ("name", "rule", "said"),
    [
        ("mat", peak(80.0), {"holds"}),
        ("mat", peak(4000.0), {"does not hold"}),
        ("mat-delay", at_delay(lambda delay: 60.0 + 1.5 * delay), {"holds"}),
        ("mat-delay", at_delay(lambda delay: 400.0 - 1.5 * delay), {"does not hold"}),
        ("mat-delay", at_delay(lambda delay: 150.0), {"undecided", "does not hold"}),
    ],
)
def test_mat_finds_a_best_threshold_that_rises_with_the_delay_and_their_absence(name, rule, said, tmp_path: Path):
    assert answers(verdicts(name, tmp_path, rule)) <= said


def test_lambda_moves_the_best_threshold_only_where_ages_depend_on_it(tmp_path: Path):
    def rule(trial):
        row = peak(200.0)(trial)
        return {**row, "age_sum_ms": 2000.0} if trial.policy == "threshold" else row

    found = verdicts("lambda", tmp_path, rule)
    assert answers(found, "threshold") == {"does not hold"} and answers(found, "drop-new, wait") == {"holds"}


@pytest.mark.parametrize("name", [n for n in ON_A_CHANNEL if n != "representations"])
def test_one_seed_decides_nothing(name, tmp_path: Path):
    assert answers(verdicts(name, tmp_path, peak(90.0), seeds=1)) == {"undecided"}


def test_omega_tells_a_plateau_from_a_peak_and_from_a_curve_that_still_rises(tmp_path: Path):
    def shaped(shape):
        def rule(trial):
            if trial.policy == "wait":
                return figures(shape(trial.value) + noise(trial.seed, trial.value), trial.value)
            return peak(60.0)(trial)

        return verdicts("omega", tmp_path, rule)

    found = shaped(lambda value: 2.0 * (1 - math.exp(-value / 20.0)))
    assert answers(found, "high traffic, threshold, PSNR (dB)", "optimum between") == {"holds"}
    assert answers(found, "high traffic, wait, PSNR (dB)", "plateau") == {"holds"}
    assert answers(found, "high traffic, wait-arrived, PSNR (dB)", "plateau") == {"does not hold"}
    assert answers(found, "high traffic, wait, F_w (6.37)", "freshness counts") == {"does not hold"}
    rising = shaped(lambda value: value / 60.0)
    assert answers(rising, "high traffic, wait, PSNR (dB)", "plateau") == {"does not hold"}


def test_verdicts_are_corrected_for_their_number():
    """One in twenty comparisons of equals has an interval that leaves out 0: of a hundred none is decided, and what is
    certain stays so."""
    lucky, certain, equal = (1.0, 0.01, 1.99, 10), (1.0, 0.9, 1.1, 10), (0.0, -1.0, 1.0, 10)
    claim = Claim("is better.", lambda table, metric, of: Finding("", (Interval(*table.values(metric, **of)[0]),)))
    better = Study("s", "s", lambda _: [], lambda cases, _: [], ("reward",), (claim,), ("scene",))
    rows = [{"scene": k, "seed": 0, "reward": row} for k, row in enumerate([lucky, certain, *[equal] * 98])]
    assert [v.verdict for v in judged(better, SeedTable(rows))] == ["undecided", "holds", *["undecided"] * 98]
    assert [v.verdict for v in judged(better, SeedTable(rows[:2]))] == ["holds", "holds"]


def test_a_curve_of_one_point_neither_rises_nor_has_an_inside():
    table = SeedTable([{"images": 3.0, "seed": k, "psnr_db": 20.0 + k} for k in (0, 1)])
    assert trend("images")(table, "psnr_db", {}) is interior("images")(table, "psnr_db", {}) is None


def test_a_claim_of_several_differences_is_as_sure_as_its_weakest_part():
    sure, weak, below = Interval(1.0, 0.9, 1.1, 10), Interval(1.0, 0.1, 1.9, 10), Interval(-1.0, -1.9, -0.1, 10)
    assert Finding("", (sure, weak)).above(0.0) is True
    assert Finding("", (sure, weak)).p_value(0.0) == weak.p_value(0.0) > sure.p_value(0.0)
    assert Finding("", (sure, below)).above(0.0) is False
    assert Finding("", (sure, below)).p_value(0.0) == 2 * below.p_value(0.0)


def test_a_study_writes_rows_verdicts_and_a_page(tmp_path: Path):
    (tmp_path / "metrics-of-another-study.png").touch()
    assert main(["metrics", "--quick", "--seeds", "2", "--out", str(tmp_path)]) == 0
    page = (tmp_path / "metrics.md").read_text()
    assert page.startswith("# What the three metrics say") and "2 seeds a point" in page
    assert "`edge-server study metrics --quick --seeds 2`" in page
    assert "false discovery rate 5 %" in page and "](metrics.png)" in page and "local ghosting" in page
    assert "metrics-of-another" not in page
    asked = request(tmp_path, scenes=("my scene.yaml",), cases=("one viewpoint",))
    assert asked.command("mat").endswith(" --scene 'my scene.yaml' --case 'one viewpoint'")
    assert {row["case"] for row in csv.DictReader((tmp_path / "metrics.csv").open())} >= {"Gaussian blur"}


TINY = {"gaussians": 256, "start": 256}
TRIAL = Trial(
    "room", 1, {"preset": "ch5"}, "threshold", 120.0, size=24, cameras=5, field_options=TINY, steps=4, lpips=False
)
NO_DATA = Folders()


def test_a_trial_repeats_bit_for_bit_whatever_ran_before_it():
    first = run_trial(TRIAL, NO_DATA)
    run_trial(replace(TRIAL, seed=5, policy="wait", value=60.0), NO_DATA)
    assert run_trial(TRIAL, NO_DATA) == first
    assert first["psnr_db"] > 5.0 and first["shown_psnr_db"] > 5.0


def test_the_three_readings_of_wait_differ_in_what_was_on_its_way():
    """Frames that were on their way block the links for up to 200 ms: none of their successors is in time. Broken off,
    the cameras' next frames are there when the wait ends."""
    channel = {"preset": "ch5", "service": {"law": "deterministic", "mean_ms": 200.0}}
    slow = replace(TRIAL, channel=channel, value=240.0, seed=4)
    found = {p: run_trial(replace(slow, policy=p), NO_DATA) for p in ("wait", "wait-arrived", "wait-flush")}
    assert found["wait-arrived"]["wait_ms"] == pytest.approx(240.0) and found["wait-arrived"]["views"] == 4.0
    assert found["wait"]["wait_ms"] > 300.0 and found["wait-arrived"]["aaoi_ms"] > 200.0
    assert found["wait-flush"]["wait_ms"] == pytest.approx(240.0) and found["wait-flush"]["views"] == 4.0


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
                row = {"case": "a case", "judged_by": "its reward", "policy": policy, **run, **labels, "seed": seed}
                places = ("elsewhere", "where it is rewarded")
                rows += [{**row, "judged_from": place, "reward": reward} for place in places]
    return SeedTable(rows)


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
    fixed = {"random": 0.0, "all": 0.5, "threshold:40": 0.4, "threshold:80": 0.6, "wait:0": 0.4, "wait:60": 0.6}
    by_state = {f"select by {variant}": 3.0 - 0.5 * gain * (3 - k) for k, variant in enumerate(WHICH_VIEWS)}
    by_state |= {
        f"{kind} by {v}": 3.0 - 0.5 * gain * k for kind in ("threshold", "wait") for k, v in enumerate(LEFT_OUT)
    }
    by_reward = {f"learned by {name}": 3.0 - gain * (name != "moving") for name in WEIGHTED}
    for name, levels, claim in (
        ("ppo-select", {"learned": 3.0 * gain}, "random set"),
        ("ppo-wait", {"learned wait": 3.0 * gain, "learned threshold": 3.0 * gain}, "best fixed omega"),
        ("ppo-wait", {"learned wait": 3.0 + gain, "learned threshold": 3.0}, "waiting beats thresholds"),
        ("ablation", by_state, "better by Z, age, pose than"),
        ("weights", by_reward, "it matters"),
        ("drift", {"learned before": 3.0, "learned afterwards": 3.0 + 0.5 * gain}, "on the new channel"),
    ):
        found = judged(STUDIES[name], table_of({**fixed, **levels}, judged_by="moving"))
        assert answers(found, claim) == {said}, name


def test_a_run_with_depth_counts_bytes_of_all_cameras_and_scores_its_last_third(tmp_path: Path):
    scene = tmp_path / "mine.yaml"
    scene.write_text(yaml.safe_dump({**RAW, "source": {**RAW["source"], "effects": {"depth_sensor": None}}}))
    runs = {every: DepthRun(str(scene), 3, every, 0.0, 0.9) for every in (0, 1)}
    found = {every: run_with_depth(run, Folders()) for every, run in runs.items()}
    assert all(row["shown_psnr_db"] > 5.0 and row["aaoi_ms"] > 10.0 and row["fps"] == 15.0 for row in found.values())
    assert {run.seed for run in STUDIES["depth"].cases(request(tmp_path))} == {0, 1}
    assert 4 * 15 * 0.2 < found[0]["kilobytes_per_s"] < 0.8 * found[1]["kilobytes_per_s"]


def test_a_scene_needs_a_held_out_camera(tmp_path: Path, capsys):
    scenes = [tmp_path / "mine.yaml", tmp_path / "none.yaml"]
    for scene, cameras in zip(scenes, (RAW["cameras"], {"count": 4})):
        scene.write_text(yaml.safe_dump({**RAW, "cameras": cameras}))
    assert checked(["mat"], request(tmp_path, scenes=(str(scenes[0]),))) == ["mat"]
    refused(StudyError, "no camera is held out", checked, ["mat"], request(tmp_path, scenes=(str(scenes[1]),)))
    (twin := tmp_path / "other" / "mine.yaml").parent.mkdir()
    twin.write_text(scenes[0].read_text())
    refused(StudyError, "two are called mine", checked, ["mat"], request(tmp_path, scenes=(str(scenes[0]), str(twin))))
    for data, here in (("none.yaml", True), ("nowhere", False)):  # beside the scenario, and not
        scenes[0].write_text(yaml.safe_dump({**RAW, "source": {"kind": "transforms", "data": data}}))
        asked = request(tmp_path, scenes=(str(scenes[0]), "tile"))
        trial.recording.cache_clear()
        for _ in range(2):
            assert trial.scenes_here(asked, ()) == [*asked.scenes[:here], "tile"]
    assert capsys.readouterr().out.count("is left out") == 1


def test_a_page_shows_the_figures_of_its_study_and_what_each_is(tmp_path, monkeypatch):
    def measure(_: Any, asked: StudyRequest) -> list[dict[str, Any]]:
        (asked.out / "omega-of-another-process.png").touch()
        of = {"scene": "room", "channel": "high traffic", "policy": "threshold"}
        return [{**of, "omega_ms": x, "seed": 0, **figures(0.0, x), **f_w(figures(0.0, x))} for x in (15.0, 60.0)]

    monkeypatch.setattr(drawing, "last_images", lambda *_: (np.zeros((8, 8, 3), np.uint8),) * 2 + ({**figures(0, 0)},))
    study.run_study(replace(STUDIES["omega"], cases=lambda _: (), measure=measure), request(tmp_path, scenes=("room",)))
    pages = [line for line in (tmp_path / "omega.md").read_text().splitlines() if line.startswith("![")]
    assert pages == [
        "![Figure 6.3, room, high traffic](omega-room-0.png)",
        "![Figure 6.4, threshold](omega-threshold-pictures.png)",
        "![Figure 6.4, wait](omega-wait-pictures.png)",
    ]


def test_selectors_stand_in_a_table_of_each_scene():
    of = {"scene": "tile", "views": viewpoints.JUDGED, "ssim": 0.5, "lpips": None, "path_m": 2.0, "choice_ms": 3.0}
    rows = [{**of, "arm": arm, "seed": k, "psnr_db": 20.0 + k} for arm in viewpoints.ARMS for k in (0, 1)]
    text = viewpoints.VIEWPOINTS.tables(SeedTable(rows))
    for line in ("## tile: PSNR (dB)", "\n| random | 20.5 [14.1, 26.9] |\n", "\n| FisherRF | 20.50 ["):
        assert line in text


FEW_VIEWS, SOME = viewpoints.Workload((3, 8), 16, 3, 24), ("random", "coverage, short way")


def test_a_scene_with_fewer_viewpoints_than_a_capture_has_is_refused():
    case = viewpoints.Capture("random", "tile", 0, replace(FEW_VIEWS, candidates=2))
    refused(ViewpointError, "2 viewpoints to choose from", viewpoints.capture, case, folders=Folders())


@pytest.mark.slow
def test_both_studies_run_whole(tmp_path, monkeypatch):
    """With few arms, tastes and habits: the others differ in what they choose."""
    monkeypatch.setattr(viewpoints, "QUICK", FEW_VIEWS)
    monkeypatch.setattr(viewpoints, "ARMS", {arm: viewpoints.ARMS[arm] for arm in SOME})
    monkeypatch.setattr(preferences, "_POOL", {True: 9})
    monkeypatch.setattr(preferences, "_UPDATES", {True: 1})
    monkeypatch.setattr(preferences, "ASKED", (2, 4))
    monkeypatch.setattr(preferences, "_ARMS", SOME[:1])
    monkeypatch.setattr(preferences, "TASTES", {"edges": preferences.TASTES["edges"]})
    request = StudyRequest(True, tmp_path, Folders(), seeds=2)
    for each in (viewpoints.VIEWPOINTS, preferences.PREFERENCES):
        assert study.run_study(each, request)
    assert "Simulated experts only" in (tmp_path / "preferences.md").read_text()
    table = list(csv.DictReader((tmp_path / "viewpoints.csv").open()))
    assert {r["arm"] for r in table} == set(SOME) and len(table) == len(SOME) * 2 * 2
    first = {r["seed"]: r["psnr_db"] for r in table if r["arm"] == "coverage, short way" and r["views"] == "3"}
    assert len(set(first.values())) == 2 and np.isfinite([float(v) for v in first.values()]).all()
    assert (tmp_path / "viewpoints-tile.png").exists() and (tmp_path / "preferences-tile.png").exists()

    # The same command again finds everything done: not even a policy is trained.
    before = (tmp_path / "preferences.csv").read_bytes()
    monkeypatch.setattr(preferences, "train_policy", None)
    study.run_study(preferences.PREFERENCES, request)
    assert (tmp_path / "preferences.csv").read_bytes() == before
