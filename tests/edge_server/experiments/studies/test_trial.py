"""Trials: the same figures whoever runs them, in whatever order, kept by all that decides them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.studies import trial as trial_module
from edge_server.experiments.studies.trial import Point, Trial, last_images, run_points, run_trial
from freshfield.scenario import ScenarioError
from tests.edge_server.experiments.studies.invented import request

TINY = {"gaussians": 256, "start": 256}
TRIAL = Trial(
    "room", 1, {"preset": "ch5"}, "threshold", 120.0, size=24, cameras=5, field_options=TINY, steps=4, lpips=False
)
NO_DATA = Folders()
SLOW = {"preset": "ch5", "service": {"law": "deterministic", "mean_ms": 200.0}}


def test_a_trial_repeats_bit_for_bit_whatever_ran_before_it():
    first = run_trial(TRIAL, NO_DATA)
    run_trial(replace(TRIAL, seed=5, policy="wait", value=60.0), NO_DATA)
    assert run_trial(TRIAL, NO_DATA) == first
    assert first["psnr_db"] > 5.0


def test_policies_decide_at_the_same_instants_on_the_same_deliveries():
    ages = [run_trial(replace(TRIAL, value=g), NO_DATA)["age_sum_ms"] for g in (30.0, 400.0)]
    assert ages[0] == ages[1] > 0.0
    assert run_trial(replace(TRIAL, seed=2), NO_DATA)["age_sum_ms"] != ages[0]


def test_the_three_readings_of_wait_differ_in_what_was_on_its_way():
    """Frames that were on their way block the links for up to 200 ms: none of their successors is in time. Broken off,
    the cameras' next frames are there when the wait ends."""
    found = {
        p: run_trial(replace(TRIAL, channel=SLOW, policy=p, value=240.0, seed=4), NO_DATA)
        for p in ("wait", "wait-arrived", "wait-flush")
    }
    assert found["wait-arrived"]["wait_ms"] == pytest.approx(240.0) and found["wait-arrived"]["views"] == 4.0
    assert found["wait"]["wait_ms"] > 300.0 and found["wait-arrived"]["aaoi_ms"] > 200.0
    assert found["wait-flush"]["wait_ms"] == pytest.approx(240.0) and found["wait-flush"]["views"] == 4.0


def shown_after_ms(trial: Trial, monkeypatch) -> list[float]:
    """How long after their publication a trial's images are looked at."""
    after_ms: list[float] = []
    scores = trial_module._shown_scores

    def noted(publication, deployment, rng):
        truth = deployment.truth
        deployment.truth = SimpleNamespace(
            nearest_ns=truth.nearest_ns,
            score=lambda shown, at_ns: after_ms.append((at_ns - publication.published_ns) / 1e6),
        )
        found = scores(publication, deployment, rng)
        deployment.truth = truth
        return found

    with monkeypatch.context() as patched:
        patched.setattr(trial_module, "_shown_scores", noted)
        run_trial(trial, NO_DATA)
    return after_ms


def test_an_image_is_looked_at_until_the_next_could_come(monkeypatch):
    free = shown_after_ms(replace(TRIAL, policy="all", value=None), monkeypatch)
    assert [int(ms // 10) for ms in free] == [0, 1, 2], "a capture period, where nothing takes time"


def test_images_are_of_the_trial():
    truth, shown, row = last_images(TRIAL, NO_DATA)
    assert truth.shape == shown.shape == (24, 24, 3)
    assert row["psnr_db"] == run_trial(TRIAL, NO_DATA)["psnr_db"]


def test_points_are_labeled_kept_and_not_run_again(tmp_path: Path, monkeypatch):
    points = [Point({"policy": "threshold", "x": v}, replace(TRIAL, value=v)) for v in (60.0, 400.0)]
    rows = run_points(points, request(tmp_path))
    assert [row["x"] for row in rows] == [60.0, 400.0] and rows[0]["psnr_db"] != rows[1]["psnr_db"]
    assert rows[0]["psnr_db"] == run_trial(points[0].trial, NO_DATA)["psnr_db"]
    assert rows[0]["f_w"] is None, "without LPIPS"
    monkeypatch.setattr(trial_module, "_decided", None)
    assert run_points(points, request(tmp_path)) == rows
    monkeypatch.undo()
    other = [replace(points[0], trial=replace(TRIAL, value=60.0, steps=5))]
    assert run_points(other, request(tmp_path))[0]["psnr_db"] != rows[0]["psnr_db"]


def test_errors_say_what_to_do(monkeypatch):
    with pytest.raises(ScenarioError, match="policy"):
        run_trial(replace(TRIAL, policy="hope"), NO_DATA)
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    with pytest.raises(ScenarioError, match="FRESHFIELD_DATA"):
        run_trial(replace(TRIAL, scene="kitchen"), NO_DATA)
