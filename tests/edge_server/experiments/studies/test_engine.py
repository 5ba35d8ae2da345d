"""Trials: the same figures whoever runs them, in whatever order; kept by content; resumed after a stop."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.studies import engine as engine_module
from edge_server.experiments.studies import trial as trial_module
from edge_server.experiments.studies.engine import Engine, StudyError, content_key, run_task
from edge_server.experiments.studies.trial import Trial, last_images, run_trial
from freshfield.scenario import ScenarioError

TINY = {"gaussians": 256, "start": 256}
TRIAL = Trial(
    "room", 1, {"preset": "ch5"}, "threshold", 120.0, size=24, cameras=5, field_options=TINY, steps=4, lpips=False
)
NO_DATA = Folders()


def quiet(_: str) -> None:
    pass


def trials() -> list[Trial]:
    found = [replace(TRIAL, seed=s, value=g) for s in (1, 2) for g in (40.0, 400.0)]
    flush, ideal = {"policy": "wait-flush", "value": 90.0}, {"channel": {"preset": "ideal"}}
    return [*found, replace(TRIAL, **flush), replace(TRIAL, **ideal)]


def test_a_trial_repeats_bit_for_bit_whatever_ran_before_it():
    first = run_trial(TRIAL, NO_DATA)
    run_trial(replace(TRIAL, seed=5, policy="wait", value=60.0), NO_DATA)
    assert run_trial(TRIAL, NO_DATA) == first
    assert first["decisions"] == 1 and first["psnr_db"] > 5.0


def test_policies_decide_at_the_same_instants_on_the_same_deliveries():
    ages = [run_trial(replace(TRIAL, value=g), NO_DATA)["age_sum_ms"] for g in (30.0, 400.0)]
    assert ages[0] == ages[1] > 0.0
    assert run_trial(replace(TRIAL, seed=2), NO_DATA)["age_sum_ms"] != ages[0]


def test_waiting_for_arrivals_takes_what_was_on_its_way_and_waiting_for_captures_does_not():
    slow = {"preset": "ch5", "service": {"law": "deterministic", "mean_ms": 200.0}}
    generated, arrived = (
        run_trial(replace(TRIAL, channel=slow, policy=p, value=240.0, seed=4), NO_DATA)
        for p in ("wait", "wait-arrived")
    )
    assert arrived["wait_ms"] == pytest.approx(240.0) and arrived["views"] == 4.0
    assert generated["wait_ms"] > arrived["wait_ms"] and arrived["aaoi_ms"] > 200.0


def test_who_waits_longer_shows_what_moves_older():
    """Of the same views: nothing is delayed, and each wait takes all cameras."""
    ideal = replace(TRIAL, channel={"preset": "ideal"}, policy="wait", steps=60, size=32, cameras=9)
    lost = []
    for value in (40.0, 400.0):
        found = [run_trial(replace(ideal, value=value, seed=s), NO_DATA) for s in (1, 2, 3)]
        assert all(row["views"] == 8.0 and row["shown_psnr_still_db"] is not None for row in found)
        lost.append(np.median([row["psnr_moving_db"] - row["shown_psnr_moving_db"] for row in found]))
    assert lost[1] > lost[0] + 0.5


def shown_after_ms(trial: Trial, monkeypatch) -> list[float]:
    """How long after their publication a trial's pictures are looked at."""
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


def test_a_picture_is_looked_at_until_the_next_could_come(monkeypatch):
    free = shown_after_ms(replace(TRIAL, policy="all", value=None), monkeypatch)
    assert [int(ms // 10) for ms in free] == [0, 1, 2], "a capture period, where nothing takes time"
    charged = shown_after_ms(replace(TRIAL, compute={"ms_per_step": 75.0}), monkeypatch)
    assert [int(ms // 100) for ms in charged] == [0, 1, 2]
    two = shown_after_ms(replace(TRIAL, scratch=False, decisions=2, settle=1), monkeypatch)
    assert len(two) == len(set(two)) == 6, "of the decisions that count, at instants of their own"


def test_nothing_is_old_where_nothing_is_delayed_and_flushing_frees_the_links():
    ideal = run_trial(replace(TRIAL, channel={"preset": "ideal"}), NO_DATA)
    assert ideal["aaoi_ms"] < 30.0 and ideal["views"] == 4.0
    slow = {"preset": "ch5", "service": {"law": "deterministic", "mean_ms": 200.0}}
    waits = [
        run_trial(replace(TRIAL, channel=slow, policy=p, value=240.0, seed=4), NO_DATA) for p in ("wait", "wait-flush")
    ]
    # Frames that were on their way block the links for up to 200 ms: none of their successors is in time, and
    # the wait goes on until the first is. Broken off, the cameras' next frames are there when it ends.
    assert waits[1]["views"] == 4.0 and waits[1]["wait_ms"] == pytest.approx(240.0)
    assert waits[0]["wait_ms"] > 300.0


def test_a_warm_field_goes_on_and_computing_ages_the_scene():
    warm = replace(TRIAL, scratch=False, first_steps=20, decisions=2, settle=1)
    charged = replace(warm, compute={"ms_per_step": 10.0})
    free, late = run_trial(warm, NO_DATA), run_trial(charged, NO_DATA)
    assert free["decisions"] == 2 and late["wait_ms"] == pytest.approx(40.0)
    assert late["age_sum_ms"] != free["age_sum_ms"]
    assert run_trial(replace(warm, scratch=True, first_steps=0), NO_DATA)["psnr_db"] != free["psnr_db"]


def test_processes_give_what_one_process_gives(tmp_path: Path):
    alone = Engine(tmp_path / "a", jobs=1, say=quiet).run(trials())
    beside = Engine(tmp_path / "b", jobs=2, say=quiet).run(trials())
    assert alone == beside
    assert len({r["psnr_db"] for r in alone}) == len(alone)


@pytest.mark.slow
@pytest.mark.alone
def test_ray_gives_what_one_process_gives(tmp_path: Path):
    ray = pytest.importorskip("ray", reason="Ray is not installed (pip install 'freshfield[cluster]')")
    alone = Engine(tmp_path / "a", jobs=1, say=quiet).run(trials())
    try:
        assert Engine(tmp_path / "b", ray="local", say=quiet).run(trials()) == alone
    finally:
        ray.shutdown()


def test_a_local_ray_that_starts_too_slowly_is_started_again():
    class Slow:
        fails, begun, ended = 1, 0, 0

        def init(self, **options):
            self.begun += 1
            if self.begun <= self.fails:
                raise Exception("The current node timed out during startup.")

        def shutdown(self):
            self.ended += 1

    ray = Slow()
    engine_module._start_ray(ray, "local")
    assert (ray.begun, ray.ended) == (2, 1)
    ray.fails = 9
    for where, begun in (("local", 4), ("10.0.0.1:6379", 5)):
        with pytest.raises(StudyError, match=f"--ray {where}: no cluster.*timed out"):
            engine_module._start_ray(ray, where)
        assert ray.begun == begun


def test_what_is_known_is_not_run_again_and_a_stop_loses_only_what_runs(tmp_path: Path, monkeypatch):
    ran: list[int] = []

    def counting(task, folders):
        if len(ran) == 2:
            raise KeyboardInterrupt
        ran.append(len(task))
        return run_task(task, folders)

    monkeypatch.setattr(engine_module, "run_task", counting)
    monkeypatch.setattr(engine_module, "_TRIALS_A_TASK", 1)
    with pytest.raises(KeyboardInterrupt):
        Engine(tmp_path, say=quiet).run(trials())
    monkeypatch.setattr(engine_module, "run_task", run_task)
    said: list[str] = []
    results = Engine(tmp_path, say=said.append).run(trials())
    assert json.loads((tmp_path / "results.jsonl").read_text().splitlines()[0])["trial"]["seed"] == 1
    assert said[0] == f"study: {len(trials()) - 2} trials to run, 2 known"
    monkeypatch.setattr(engine_module, "run_task", counting)
    assert Engine(tmp_path, say=quiet).run(trials()) == results, "nothing left to run"


def test_the_key_is_of_all_that_decides(tmp_path: Path):
    keys = {content_key(t, NO_DATA) for t in (*trials(), replace(TRIAL, steps=5), replace(TRIAL, size=32))}
    assert len(keys) == len(trials()) + 2
    assert content_key(TRIAL, NO_DATA) == content_key(replace(TRIAL), NO_DATA)


def test_a_task_of_another_kind_of_processor_is_refused():
    with pytest.raises(StudyError, match="other last bits than x86_64 pentium"):
        run_task([TRIAL.mapping()], NO_DATA, "x86_64 pentium")


def test_pictures_are_of_the_trial(tmp_path: Path):
    truth, shown, row = last_images(TRIAL, NO_DATA)
    assert truth.shape == shown.shape == (24, 24, 3)
    assert row["psnr_db"] == run_trial(TRIAL, NO_DATA)["psnr_db"]


def test_errors_say_what_to_do(tmp_path: Path, monkeypatch):
    with pytest.raises(ScenarioError, match="policy"):
        run_trial(replace(TRIAL, policy="hope"), NO_DATA)
    with pytest.raises(ScenarioError, match="FRESHFIELD_DATA"):
        monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
        run_trial(replace(TRIAL, scene="kitchen"), NO_DATA)
    import sys

    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(StudyError, match="pip install"):
        Engine(tmp_path, ray="auto", say=quiet).run([TRIAL])
