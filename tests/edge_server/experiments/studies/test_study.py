"""The studies of trials: their points are sound, their verdicts follow from the figures and can come out either way."""

from __future__ import annotations

import csv
import json
import math
from pathlib import Path

import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.common.statistics import Interval
from edge_server.experiments.studies.registry import ON_A_CHANNEL, STUDIES
from edge_server.experiments.studies.study import Claim, Finding, Study, StudyRequest, judge
from edge_server.experiments.studies.study_command import main
from edge_server.scheduler import make_policy
from tests.edge_server.experiments.studies.invented import answers, figures, noise, peak, verdicts


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


OWN_SCENE = """
name: mine
cameras: {count: 4, held_out: [cam03]}
source: {kind: world, scene: room, width: 40, height: 30, fps: 10}
channel: {preset: ch5}
edge: {lpips: none}
"""


@pytest.mark.slow  # some seconds of fits
def test_figure_6_3_is_made_of_ones_own_channel_and_scene(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr("edge_server.experiments.studies.waiting_curves.QUICK_OMEGAS", (60.0, 120.0))
    scene, channel, out = tmp_path / "mine.yaml", tmp_path / "slow.yaml", tmp_path / "out"
    scene.write_text(OWN_SCENE)
    channel.write_text("{service: 'det:40ms', discipline: drop-new}")
    words = ["--scene", str(scene), "--channel", str(channel), "--seeds", "1", "--jobs", "1", "--out", str(out)]
    assert main(["omega", "--quick", *words]) == 0
    assert "mine, slow, threshold" in capsys.readouterr().out
    assert {row["channel"] for row in csv.DictReader((out / "omega.csv").open())} == {"slow", ""}
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
    ],
)
def test_mat_finds_a_best_threshold_that_rises_with_the_delay_and_their_absence(name, rule, said, tmp_path: Path):
    assert answers(verdicts(name, tmp_path, rule)) == said


def test_a_best_threshold_that_is_the_same_at_every_delay_does_not_rise(tmp_path: Path):
    assert "holds" not in answers(verdicts("mat-delay", tmp_path, at_delay(lambda delay: 150.0)))


def test_lambda_moves_the_best_threshold_only_where_it_counts_used_views(tmp_path: Path):
    def rule(trial):
        row = peak(200.0)(trial)
        return {**row, "age_sum_ms": 2000.0} if trial.policy == "threshold" else row

    found = verdicts("lambda", tmp_path, rule)
    assert answers(found, "threshold, all cameras (5.8)") == {"does not hold"}
    assert answers(found, "threshold, used views (6.35)") == {"holds"}
    assert answers(found, "wait, all cameras (5.8)") == {"holds"}


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
    assert answers(found, "high traffic, wait-flush, PSNR (dB)", "plateau") == {"does not hold"}
    assert answers(found, "high traffic, wait, F_w (6.37)", "freshness counts") == {"does not hold"}
    rising = shaped(lambda value: value / 60.0)
    assert answers(rising, "high traffic, wait, PSNR (dB)", "plateau") == {"does not hold"}


def test_verdicts_are_corrected_for_their_number():
    """One in twenty comparisons of equals has an interval that leaves out 0: of a hundred none is decided, and what is
    certain stays so."""

    def at(table, metric, labels):
        return Finding("", (Interval(*table.values(metric, **labels)[0]),))

    lucky, certain, equal = (1.0, 0.01, 1.99, 10), (1.0, 0.9, 1.1, 10), (0.0, -1.0, 1.0, 10)
    claim = Claim("is better.", at)
    study = Study("s", "s", lambda _: [], lambda cases, _: [], ("reward",), (claim,), ("scene",))
    rows = [{"scene": k, "seed": 0, "reward": row} for k, row in enumerate([lucky, certain, *[equal] * 98])]
    assert [v.verdict for v in judge(study, SeedTable(rows))] == ["undecided", "holds", *["undecided"] * 98]
    assert [v.verdict for v in judge(study, SeedTable(rows[:2]))] == ["holds", "holds"]


def test_a_claim_of_several_differences_is_as_sure_as_its_weakest_part():
    sure, weak, below = Interval(1.0, 0.9, 1.1, 10), Interval(1.0, 0.1, 1.9, 10), Interval(-1.0, -1.9, -0.1, 10)
    assert Finding("", (sure, weak)).above(0.0) is True
    assert Finding("", (sure, weak)).p_value(0.0) == weak.p_value(0.0) > sure.p_value(0.0)
    assert Finding("", (sure, below)).above(0.0) is False
    assert Finding("", (sure, below)).p_value(0.0) == 2 * below.p_value(0.0)


def test_a_study_writes_rows_verdicts_and_a_page(tmp_path: Path):
    assert main(["metrics", "--quick", "--seeds", "2", "--out", str(tmp_path)]) == 0
    found = json.loads((tmp_path / "metrics.json").read_text())
    assert found["command"] == "edge-server study metrics --quick --seeds 2"
    assert found["verdicts"] and all(v["verdict"] for v in found["verdicts"])
    page = (tmp_path / "metrics.md").read_text()
    assert page.startswith("# What the three metrics say") and "2 seeds a point" in page
    assert "false discovery rate 5 %" in page and "![" in page and "local ghosting" in page
    assert {row["case"] for row in csv.DictReader((tmp_path / "metrics.csv").open())} >= {"Gaussian blur"}
