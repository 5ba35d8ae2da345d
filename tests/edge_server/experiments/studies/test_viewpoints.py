"""The studies of viewpoints and preferences: whole on a tiny workload; verdicts can come out either way."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.studies import preferences, viewpoints
from edge_server.experiments.studies.study import StudyRequest, run_study

TINY, SOME = viewpoints.Workload((3, 8), 16, 3, 24), ("random", "coverage, short way")


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
