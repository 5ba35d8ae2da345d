"""Trials: the same figures whoever runs them, in whatever order, kept by all that decides them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.studies import trial as trial_module
from edge_server.experiments.studies.trial import Point, Trial, run_points, run_trial
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
    assert first["psnr_db"] > 5.0 and first["shown_psnr_db"] > 5.0


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
