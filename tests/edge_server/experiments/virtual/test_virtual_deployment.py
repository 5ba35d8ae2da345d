"""A deployment in virtual time: repeatable, books that close, time charged as said; the command that runs one."""

import json
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from channel_emu.model.link import EventKind
from channel_emu.model.settings import channel_from_mapping
from channel_emu.virtual.simulate import simulate
from edge_server.experiments.virtual import costs_command
from edge_server.experiments.virtual.costs_command import fitted
from edge_server.experiments.virtual.costs_command import main as costs_main
from edge_server.experiments.virtual.from_scenario import build_deployment, training_cameras
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.simulate_command import digest, main
from edge_server.experiments.virtual.try_policy import try_policy
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.report.build_report import build_report
from edge_server.scheduler import Policy
from edge_server.scheduler.learned.decision_record import read_decision
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import ComputeConfig, read_config
from freshfield.frame import to_request
from freshfield.scenario import Scenario, ScenarioError, load
from tests.edge_server.experiments.rollouts.small import RAW
from tests.edge_server.experiments.rollouts.small import scenario as small_scenario
from tests.edge_server.experiments.sets import SMALL, write_photos
from tests.support import refused, small_world

SETTINGS = RunSettings(steps=2, compute=ComputeConfig(ms_per_step=40.0, ms_per_update=20.0))


def scenario(channel: dict[str, Any] | None = None, **other: Any) -> Scenario:
    edge = {"field": "ngp", "field_options": SMALL}
    return small_scenario(channel, **{"source": small_world(), "edge": edge, **other})


def run(what: Scenario, settings: RunSettings = SETTINGS, seconds: float = 1.0) -> VirtualDeployment:
    deployment = build_deployment(what, settings)
    deployment.run(seconds)
    return deployment


def closes(frames: dict[str, Any]) -> bool:
    ends = ("skipped", "dropped_busy", "superseded", "lost", "broken", "delivered", "in_flight")
    out = sum(frames[name] for name in ends) + sum(frames["rejected"].values())
    sent = frames["captured"] - frames["replaced"] - frames["waiting"]
    return sent == frames["sent"] and frames["sent"] + frames["duplicated"] == out


_SHARES = {kind: {"probability": share} for kind, share in (("loss", 0.1), ("corruption", 0.2), ("duplication", 0.2))}
FAULTS = {"preset": "ch6", "faults": {**_SHARES, "reset": {"at_ms": [400.0]}, "bandwidth": {"megabits_per_s": 2.0}}}


@pytest.mark.parametrize("channel", [{"preset": "ch5"}, FAULTS], ids=["ch5", "faults"])
def test_one_seed_gives_the_same_run_bit_for_bit(channel):
    first, second = (run(scenario(channel)) for _ in range(2))
    assert first.publications and first.publications == second.publications
    frames = first.frames()
    assert closes(frames) and frames == second.frames()
    if channel is FAULTS:
        assert frames["rejected"]["crc_mismatch"] > 0 and frames["rejected"]["replayed_sequence"] > 0
        assert frames["lost"] > 0 and frames["broken"] > 0 and frames["skipped"] > 0
    a, b = (d.updates.field.state() for d in (first, second))
    assert a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)
    other = run(scenario(channel, seed=4))
    assert [p.ages_ms for p in other.publications] != [p.ages_ms for p in first.publications]
    assert digest(first) == digest(second) != digest(other)


@pytest.mark.parametrize("every", [1, 5])
def test_depth_is_in_one_of_so_many_frames_and_takes_its_time_on_the_line(every):
    rate, sensors = {"preset": "ideal", "faults": {"bandwidth": 1.0}}, {"depth_sensor": {}}
    seen: dict[int, bool] = {}
    deployment = build_deployment(scenario(rate, source=small_world(depth_every=every, effects=sensors)), SETTINGS)
    for _ in range(12):
        deployment.run(1 / 15)
        for item in deployment.updates.buffer.newest().values():
            took_ns = item.received_ns - item.generated_ns
            assert took_ns == pytest.approx(8000 * to_request(item).ByteSize(), abs=1)
            seen[item.sequence] = item.depth is not None
    expected = {1: set(seen), 5: {0, 5, 10}}[every]
    assert len(seen) > 8 and {sequence for sequence in seen if seen[sequence]} == expected & set(seen)


@pytest.mark.parametrize(
    "channel",
    [{"preset": "ch5"}, {"preset": "ch5", "discipline": "newest-waits", "server": {"shared": True}}],
    ids=["own lines", "one line"],
)
def test_the_links_decide_as_the_simulation_does(channel):
    what = scenario(channel)
    deployment = run(what, RunSettings(steps=1, compute=ComputeConfig(ms_per_update=500.0)), seconds=2.0)
    channel = channel_from_mapping(what.channel)
    alone = simulate(channel, list(what.training), 2.0, what.seed, frame_period_ms=1e3 / 15)
    assert dict(deployment.delivered) == {r.camera: r.link.counts[EventKind.DELIVERED] for r in alone.runs}


def test_the_present_is_when_the_charge_is_over():
    deployment = run(scenario())
    assert {p.update_ms for p in deployment.publications} == {100.0}
    ends = [p.published_ns for p in deployment.publications]
    assert {b - a for a, b in pairwise(ends)} == {100_000_000}, "the next update starts at once"
    assert all(p.psnr_db is not None and p.truth_gap_ms == 0.0 for p in deployment.publications)


def test_free_compute_publishes_at_the_decision_and_never_spins():
    free = run(scenario({}), RunSettings(steps=1, compute=ComputeConfig()), seconds=0.5)
    assert {p.update_ms for p in free.publications} == {0.0}
    assert len(free.publications) == 8, "once an arrival instant: ticks 0 to 7 of 15 a second"
    epochs = run(scenario({}), RunSettings(steps=1, epoch_ms=200.0), seconds=1.0)
    times = [p.published_ns for p in epochs.publications]
    assert np.diff(times).tolist() == [200_000_000] * (len(times) - 1)


def test_a_camera_that_reports_late_is_waited_for_only_as_long_as_the_grace():
    channel = {"service": {"law": "deterministic", "mean_ms": 700.0}}
    what = scenario(channel, cameras={**RAW["cameras"], "phase": "spread"})
    at_once, soon, all_there = (
        run(what, RunSettings(steps=1, grace_ms=grace_ms), seconds=1.5).publications[0]
        for grace_ms in (0.0, 5.0, 900.0)
    )
    assert at_once.published_ns > 700_000_000 and len(at_once.selected) == 1
    assert soon.published_ns - at_once.published_ns == 5_000_000
    assert 5_000_000 < all_there.published_ns - at_once.published_ns < 66_700_000 and len(all_there.selected) == 4


def test_what_is_shown_is_the_newest_publication_carried_on_to_seeded_instants() -> None:
    settings = RunSettings(steps=2, compute=ComputeConfig(ms_per_step=40.0, ms_per_update=20.0), shown_every_ms=70.0)
    deployment = build_deployment(scenario(), settings)
    asked: list[tuple[int, int]] = []
    take = deployment.updates.field.snapshot

    def snapshot(published_ns: int) -> Any:
        taken = take(published_ns)
        return SimpleNamespace(at=lambda now_ns: asked.append((published_ns, now_ns)) or taken.at(now_ns))

    deployment.updates.field.snapshot = snapshot  # type: ignore[method-assign, assignment]
    deployment.settings = replace(settings, score_every_ms=None)
    published = [p.published_ns for p in deployment.run(1.5)]
    assert len(asked) == len(deployment.shown) > 5
    for newest_ns, at_ns in asked:
        assert newest_ns == max(p for p in published if p <= at_ns)
    assert [s.published_ns for s in deployment.shown] == [at for _, at in asked]
    periods = {s.published_ns // 70_000_000 for s in deployment.shown}
    assert len(periods) == len(deployment.shown), "one in each period"


def write(tmp_path: Path, **edge: Any) -> Path:
    lossy = {"preset": "ch5", "faults": {"loss": {"probability": 0.1}}}
    section = {**RAW, "channel": lossy, "edge": {"field": "ngp", "field_options": SMALL, "steps": 2, **edge}}
    (path := tmp_path / "small.yaml").write_text(yaml.safe_dump(section))
    return path


def simulated(path: Path, capsys, *words: str) -> dict[str, Any]:
    assert main([str(path), "--seconds", "1.5", "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_charge_is_the_scenarios_or_the_commands(tmp_path: Path, capsys):
    path = write(tmp_path, compute={"ms_per_step": 40.0, "ms_per_update": 20.0})
    assert simulated(path, capsys)["update_ms"] == pytest.approx(100.0)
    assert simulated(path, capsys, "--compute", "zero")["update_ms"] == 0.0
    assert simulated(path, capsys, "--compute", "5:1", "--steps", "4")["update_ms"] == pytest.approx(21.0)


def test_a_policy_is_tried_from_a_library(tmp_path: Path):
    trial = try_policy("freshest-k:2", write(tmp_path), 1.5)
    decided = [(row.t_s, row.aaoi_ms) for row in trial.decisions]
    assert trial.policy == "freshest-k" and len(decided) > 2
    assert trial.ages_ms.tolist() == [list(row) for row in decided]
    assert trial.shown[:, 1].tolist() == [score.psnr_db for score in trial.scores] and trial.psnr_db > 5.0

    class Mine(Policy):  # without a name, as on the page of plug-ins
        def select(self, epoch, window):
            return tuple(epoch.generated_ns)

    assert try_policy(Mine(None, np.random.default_rng(0)), write(tmp_path), 0.5).policy == "Mine"


def test_what_a_learned_policy_decided_and_what_scored_it_is_kept_as_of_a_live_run(tmp_path: Path, monkeypatch):
    too_large = SimpleNamespace(minimum_side=1000)  # for these images: it is not asked
    monkeypatch.setattr("edge_server.experiments.virtual.simulate_command.open_lpips", lambda _: (too_large, None))
    Learner(Spec("select", StateLayout(("age", "pose")), hidden=8), 1).save(tmp_path / "policy.npz")
    out, file = tmp_path / "out", write(tmp_path)
    words = ["--seconds", "1.5", "--out", str(out), "--policy", f"bandit:{tmp_path / 'policy.npz'}"]
    assert main([str(file), *words]) == 0
    assert json.loads((out / "edge.json").read_text())["lpips_network"] == "alex"
    lines = [json.loads(line) for line in (out / "series.jsonl").read_text().splitlines()]
    for number in (0, lines[-1]["number"]):
        decided = read_decision(out, number).decision
        used = [c for c, chosen in zip(decided.state.cameras, decided.action) if chosen]
        assert lines[number]["selected"] == used
    assert main([str(file), *words[:-1], "all"]) == 0  # a run without any, in the same folder
    assert not list(out.glob("decisions/*"))


def test_costs_are_measured_into_the_file_that_a_scenario_names(tmp_path: Path, capsys):
    out = tmp_path / "costs_command.json"
    assert costs_main([str(write(tmp_path, steps=5)), "--seconds", "0.6", "--out", str(out)]) == 0
    found = json.loads(out.read_text())["compute"]
    assert sum(found.values()) > 0.0
    assert read_config(load(write(tmp_path, compute="costs_command.json"))).compute == ComputeConfig(**found)
    for wrong in ("missing.json", 3):
        refused(ScenarioError, r"edge\.compute", read_config, load(write(tmp_path, compute=wrong)))


def test_what_is_done_beside_an_update_live_is_not_charged(tmp_path: Path, monkeypatch):
    def build(*given: Any, **more: Any) -> VirtualDeployment:
        deployment = build_deployment(*given, **more)
        field = deployment.updates.field
        fit, field.beside_s = field.fit, 0.0

        def slow(*given: Any) -> Any:
            field.beside_s += 100.0  # says so, and does not take it
            return fit(*given)

        field.fit = slow
        return deployment

    monkeypatch.setattr(costs_command, "build_deployment", build)
    assert costs_command.measure(load(write(tmp_path, steps=2)), 0.6)["median_ms"] < -90_000.0


def test_costs_are_told_apart():
    rng = np.random.default_rng(0)
    steps, frames = rng.integers(1, 11, 200), rng.integers(0, 9, 200)
    took_ms = 0.5 * steps + 2.0 * frames + 3.0
    took_ms[:10] += 100.0  # while the machine did something else
    found = fitted(np.column_stack([steps, frames, took_ms]))
    assert (found.ms_per_step, found.ms_per_view, found.ms_per_update) == (0.5, 2.0, 3.0)


def test_an_arm_keeps_real_time():
    refused(ScenarioError, r"cell.yaml: source: .* cannot be run in virtual time", training_cameras, load("cell"))


def test_cameras_that_are_seen_to_move_become_a_scan_and_the_reason_is_said(tmp_path: Path, capsys):
    write_photos(tmp_path / "set", 19)
    source = {"kind": "transforms", "data": str(tmp_path / "set"), "fps": 10}
    cameras, edge = {"count": 4, "held_out": ["cam00"]}, {"lpips": "none", "grace_ms": 0.0}
    (path := tmp_path / "photos.yaml").write_text(json.dumps({"cameras": cameras, "source": source, "edge": edge}))
    assert main([str(path), "--seconds", "3", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert re.fullmatch(r"splat as a scan, updated in a cycle for 80 ms: cam0[123] moves", found["chosen"])
    assert found["steps"] == 8


def test_newest_and_all_held_out_frames_are_scored_each_two_seconds_and_reported(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    cameras = {"ids": ["hand", "kept"], "held_out": ["kept"], "held_out_every": 8}
    walked = {"fps": 10, "carried": ["hand"], "params": {"people": 0, "supersample": 1}}
    path, run = write(tmp_path), tmp_path / "run"
    section = yaml.safe_load(path.read_text())
    path.write_text(yaml.safe_dump({**section, "cameras": cameras, "source": {**section["source"], **walked}}))
    assert main([str(path), "--seconds", "5", "--json", "--out", str(run)]) == 0
    means = json.loads(capsys.readouterr().out)["now_and_all"]
    last = json.loads((run / "edge.json").read_text())["so_far"]
    # Frames of 0, .8, ..., 4.0 s; marks at 2 and 4 s, and means are those from 4 s on.
    assert last["frames"] == 6 and last["now_psnr_db"] != last["all_psnr_db"]
    assert means == pytest.approx({name: last[name] for name in means}) and "all_ssim" in means
    shown = [json.loads(line) for line in (run / "shown.jsonl").read_text().splitlines()]
    assert [row.get("so_far") is not None for row in shown] == [row["t_s"] >= 2.0 for row in shown]
    assert shown[-1]["so_far"] == last and build_report(run)["fidelity"]["so_far"] == last


@pytest.mark.slow
def test_at_twice_the_load_frames_are_left_out_and_what_is_shown_does_not_age() -> None:
    """A processor that takes in less than 100 frames a second; sixty of them, and twice as many."""
    options = {"layers": True, "gaussians": 300, "start": 200, "seed_cells": 12, "threads": 1}
    edge = {"field": "splat", "field_options": options, "policy": {"name": "all"}, "updates": "arrivals"}
    compute = ComputeConfig(ms_per_update=5.0, ms_per_view=10.0)
    settings = RunSettings(steps=1, compute=compute, epoch_ms=40.0, score_every_ms=None)
    ages = []
    for fps in (15.0, 30.0):
        deployment = run(scenario({}, edge=edge, source=small_world(fps=fps)), settings, seconds=6.0)
        late = [p for p in deployment.publications if p.t_s > 2.0]
        assert max(p.update_ms for p in late) <= 80.0
        halves = [np.mean([p.aaoi_ms for p in late if (p.t_s > 4.0) is second]) for second in (False, True)]
        assert halves[1] < 1.1 * halves[0]
        ages.append(np.mean(halves))
        assert closes(deployment.frames())
    assert deployment.updates.buffer.shed > 0.1 * deployment.updates.buffer.arrivals
    assert ages[1] < 2.0 * ages[0]
