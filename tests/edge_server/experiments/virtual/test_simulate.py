"""``edge-server simulate``: one seed, one digest; what the scenario charges; errors for people."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from edge_server.experiments.virtual import costs
from edge_server.experiments.virtual.costs import fitted
from edge_server.experiments.virtual.costs import main as costs_main
from edge_server.experiments.virtual.from_scenario import build_deployment, training_cameras
from edge_server.experiments.virtual.simulate import main
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.report.build_report import build_report
from edge_server.scheduler.learned.decision_record import read_decision
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.settings import Spec
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import ComputeConfig, read_config
from freshfield.scenario import ScenarioError, load
from tests.edge_server.experiments.rollouts.small import RAW
from tests.edge_server.experiments.sets import SMALL, write_photos


def write(tmp_path: Path, **edge: Any) -> Path:
    lossy = {"preset": "ch5", "faults": {"loss": {"probability": 0.1}}}
    section = {**RAW, "channel": lossy, "edge": {"field": "ngp", "field_options": SMALL, "steps": 2, **edge}}
    (path := tmp_path / "small.yaml").write_text(yaml.safe_dump(section))
    return path


def run(path: Path, capsys, *words: str) -> dict[str, Any]:
    assert main([str(path), "--seconds", "1.5", "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_the_charge_is_the_scenarios_or_the_commands(tmp_path: Path, capsys):
    path = write(tmp_path, compute={"ms_per_step": 40.0, "ms_per_update": 20.0})
    assert run(path, capsys)["update_ms"] == pytest.approx(100.0)
    assert run(path, capsys, "--compute", "zero")["update_ms"] == 0.0
    assert run(path, capsys, "--compute", "5:1", "--steps", "4")["update_ms"] == pytest.approx(21.0)
    assert run(path, capsys, "--policy", "wait-flush:60")["policy"] == "wait-flush"


def test_what_a_learned_policy_decided_is_kept_as_of_a_live_run(tmp_path: Path):
    Learner(Spec("select", StateLayout(("age", "pose")), hidden=8), 1).save(tmp_path / "policy.npz")
    out, file = tmp_path / "out", write(tmp_path)
    words = ["--seconds", "1.5", "--out", str(out), "--policy", f"bandit:{tmp_path / 'policy.npz'}"]
    assert main([str(file), *words]) == 0
    lines = [json.loads(line) for line in (out / "series.jsonl").read_text().splitlines()]
    for number in (0, lines[-1]["number"]):
        decided = read_decision(out, number).decision
        used = [c for c, chosen in zip(decided.state.cameras, decided.action) if chosen]
        assert lines[number]["selected"] == used
    assert main([str(file), "--seconds", "1.5", "--out", str(tmp_path / "fixed"), "--policy", "all"]) == 0
    assert not (tmp_path / "fixed" / "decisions").exists()


def test_costs_are_measured_into_the_file_that_a_scenario_names(tmp_path: Path, capsys):
    out = tmp_path / "costs.json"
    assert costs_main([str(write(tmp_path, steps=5)), "--seconds", "1.2", "--out", str(out)]) == 0
    found = json.loads(out.read_text())["compute"]
    assert sum(found.values()) > 0.0
    assert read_config(load(write(tmp_path, compute="costs.json"))).compute == ComputeConfig(**found)
    for wrong in ("missing.json", 3):
        with pytest.raises(ScenarioError, match=r"edge\.compute"):
            read_config(load(write(tmp_path, compute=wrong)))


@pytest.mark.parametrize("part", ["static field", "static renders"])
def test_what_is_done_beside_an_update_live_is_not_charged(part: str, tmp_path: Path, monkeypatch):
    def build(*given: Any, **more: Any) -> VirtualDeployment:
        deployment = build_deployment(*given, **more)
        field = deployment.updates.field
        fit, field.part_s = field.fit, {part: 0.0}

        def slow(*given: Any) -> Any:
            field.part_s[part] += 100.0  # says so, and does not take it
            return fit(*given)

        field.fit = slow
        return deployment

    monkeypatch.setattr(costs, "build_deployment", build)
    assert costs.measure(load(write(tmp_path, steps=2)), 0.6)["median_ms"] < -90_000.0


def test_costs_are_told_apart():
    rng = np.random.default_rng(0)
    steps, frames = rng.integers(1, 11, 200), rng.integers(0, 9, 200)
    took_ms = 0.5 * steps + 2.0 * frames + 3.0
    took_ms[:10] += 100.0  # while the machine did something else
    found = fitted(np.column_stack([steps, frames, took_ms]))
    assert (found.ms_per_step, found.ms_per_view, found.ms_per_update) == (0.5, 2.0, 3.0)


def test_an_arm_keeps_real_time():
    with pytest.raises(ScenarioError, match=r"cell.yaml: source: .* cannot be run in virtual time"):
        training_cameras(load("cell"))


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
