"""The studies of viewpoints and preferences: whole on a tiny workload; verdicts can come out either way."""

from __future__ import annotations

import csv
from types import SimpleNamespace

import numpy as np
import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import SeedTable
from edge_server.experiments.scenes.multiview_still import score_views
from edge_server.experiments.studies import preferences, viewpoints
from edge_server.experiments.studies.study import StudyRequest, judge, run_study
from edge_server.experiments.viewpoints.reconstructions import varied_plan
from edge_server.fields import Rendering, View
from edge_server.viewpoints.candidates import half_hemisphere
from freshfield.geometry import Pinhole
from tests.edge_server.experiments.studies.invented import answers

TINY, SOME = viewpoints.Workload((3, 8), 16, 3, 24), ("random", "coverage, short way")


def test_verdicts_of_viewpoints_follow_the_figures():
    for better, answer in ((1.0, "holds"), (-1.0, "does not hold")):
        rows = [
            {
                "scene": "tile",
                "arm": arm,
                "seed": s,
                "views": v,
                "psnr_db": 20 + v * better + 0.01 * s * (v + (arm != "random")) + (arm != "random") * better,
                "path_m": 5.0 - better * (arm != "random") + 0.01 * s * (arm == "random"),
            }
            for arm in viewpoints.ARMS
            for s in range(4)
            for v in (3, 8)
        ]
        assert answers(judge(viewpoints.VIEWPOINTS, SeedTable(rows))) == {answer}


def test_tables_of_viewpoints_give_each_metric_its_decimals():
    metrics = {"psnr_db": 20.06, "ssim": 0.8126, "lpips": 0.2004, "path_m": 5.0, "choice_ms": 7.25}
    rows = [
        {"scene": "tile", "arm": arm, "seed": 0, "views": views, **metrics, "psnr_db": 20.06 + views}
        for arm in viewpoints.ARMS
        for views in (3, viewpoints.JUDGED)
    ]
    counts, judged = viewpoints._tables(SeedTable(rows)).split("With ")
    assert "| selector | 3 | 8 |" in counts and "| random | 23.1 | 28.1 |" in counts
    assert "| random | 28.06 | 0.813 | 0.200 | 5.00 | 7.2 |" in judged


@pytest.mark.parametrize(("share", "knows", "said"), [(0.95, False, "holds"), (0.85, True, "does not hold")])
def test_verdicts_of_preferences_follow_the_answers(share, knows, said):
    rows = [
        {
            "scene": "tile",
            "taste": t,
            "habit": h,
            "answers": 60,
            "seed": s,
            "agreement_share": share + 0.001 * s,
            "does_not_know": float(not knows),
        }
        for t in preferences.TASTES
        for h in preferences.HABITS
        for s in range(4)
    ]
    found = judge(preferences.PREFERENCES, SeedTable(rows))
    assert answers(found) == {said} and len(found) == len(preferences.TASTES) + 1


def test_a_policy_is_judged_by_quality_and_by_its_path():
    captures = [
        {"scene": "tile", "arm": arm, "seed": s, "psnr_db": db + 0.01 * s * k, "path_m": m + 0.01 * s * k}
        for k, (arm, db, m) in enumerate((("random", 20.0, 5.0), ("FisherRF", 22.0, 2.0), ("policy, edges", 21.0, 3.0)))
        for s in range(4)
    ]
    found = {v.claim: v.verdict for v in judge(preferences.PREFERENCES, SeedTable(captures))}
    assert found == {
        "better views than random's (table 4.3).": "holds",
        "a shorter path than random's (table 4.3).": "holds",
        "better views than FisherRF's (table 4.3).": "does not hold",
        "a shorter path than FisherRF's (table 4.3).": "does not hold",
    }


def test_a_capture_of_a_transparent_object_is_scored_over_the_scenes_background():
    """A perfect reconstruction of a picture that is nearly all transparent."""
    lens, pose = Pinhole(32, 32, 30.0, 30.0, 16.0, 16.0), np.eye(4)
    image = np.zeros((32, 32, 4), np.uint8)
    image[10:20, 10:20] = (200, 50, 50, 255)

    class Perfect:
        def render(self, *camera):
            color = np.where(image[..., 3:] > 0, image[..., :3] / 255.0, 1.0).astype(np.float32)
            return Rendering(color, np.ones((32, 32), np.float32), np.ones((32, 32), np.float32))

    view = View("test", image, pose, lens)
    stage = SimpleNamespace(
        background=(1.0, 1.0, 1.0),
        held_out=(view,),
        fit=lambda *_: Perfect(),
        score=lambda made, scorer: score_views(made, (view,), scorer)[0],
    )
    made = SimpleNamespace(views=[view], stops=[SimpleNamespace(seconds=0.0)] * 2, path_m=1.0)
    assert preferences._measured(stage, made, TINY, 0)["psnr_db"] > 60.0


def test_plans_to_compare_have_the_views_asked_for_where_candidates_are_few():
    some = half_hemisphere(np.zeros(3), 1.0, Pinhole(16, 16, 15.0, 15.0, 8.0, 8.0), 16)
    stage = SimpleNamespace(candidates=some, take=lambda k: k)
    assert {len(varied_plan(stage, k, 8).order) for k in range(12)} == {8}


@pytest.mark.slow
def test_both_studies_run_whole(tmp_path, monkeypatch):
    """With few arms, tastes and habits: the others differ in what they choose."""
    monkeypatch.setattr(viewpoints, "QUICK", TINY)
    monkeypatch.setattr(viewpoints, "ARMS", {arm: viewpoints.ARMS[arm] for arm in SOME})
    monkeypatch.setattr(viewpoints, "_SHOWN", SOME[:1])
    monkeypatch.setattr(preferences, "_POOL", {True: 9})
    monkeypatch.setattr(preferences, "_UPDATES", {True: 1})
    monkeypatch.setattr(preferences, "ASKED", (2, 4))
    monkeypatch.setattr(preferences, "_ARMS", SOME[:1])
    monkeypatch.setattr(preferences, "TASTES", {"edges": preferences.TASTES["edges"]})
    request = StudyRequest(True, tmp_path, Folders(), seeds=2)
    for study in (viewpoints.VIEWPOINTS, preferences.PREFERENCES):
        assert run_study(study, request)
    assert "Simulated experts only" in (tmp_path / "preferences.md").read_text()
    table = list(csv.DictReader((tmp_path / "viewpoints.csv").open()))
    assert {r["arm"] for r in table} == set(SOME) and len(table) == len(SOME) * 2 * 2
    first = {r["seed"]: r["psnr_db"] for r in table if r["arm"] == "coverage, short way" and r["views"] == "3"}
    assert len(set(first.values())) == 2 and np.isfinite([float(v) for v in first.values()]).all()
    assert (tmp_path / "viewpoints-tile-paths.png").exists() and (tmp_path / "preferences-tile.png").exists()

    # The same command again finds everything done: not even a policy is trained.
    before = (tmp_path / "preferences.csv").read_bytes()
    monkeypatch.setattr(preferences, "train_policy", None)
    run_study(preferences.PREFERENCES, request)
    assert (tmp_path / "preferences.csv").read_bytes() == before
