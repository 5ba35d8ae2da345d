"""``edge-server compare``: policies with intervals, paired by seed, on anybody's channel."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml

from edge_server.experiments import compare
from edge_server.experiments.common.channels import read_channel
from edge_server.experiments.common.seed_table import SeedTable
from freshfield.scenario import ScenarioError
from tests.edge_server.experiments.rollouts.small import RAW


def table_of(gain: float, spread: float) -> SeedTable:
    rows = []
    for seed in range(6):
        for policy, psnr_db in (("all", 20.0 + seed), ("wait:60", 20.0 + seed + gain + spread * (-1) ** seed)):
            figures = {"psnr_db": psnr_db, "psnr_moving_db": 15.0 + seed, "views": 4.0}
            rows.append({"policy": policy, "seed": seed, **figures})
    return SeedTable(rows)


def test_differences_are_paired_by_seed_and_a_star_marks_what_is_decided():
    lines = compare.as_text(table_of(0.5, 0.1), ["all", "wait:60"]).splitlines()
    assert lines[0].split("  ")[0] == "policy" and "minus all" in lines[0]
    assert "0.50 [0.39, 0.61] *" in lines[2], "seeds differ by 5 dB, the pairs by 0.2"
    assert "*" not in compare.as_text(table_of(0.05, 0.1), ["all", "wait:60"])
    found = compare.as_json(table_of(0.5, 0.1), ["all", "wait:60"])
    assert found["wait:60"]["psnr_db_over_all"][0] == 0.5 and found["all"]["psnr_db_over_all"] == [0.0, 0.0, 0.0]
    assert found["all"]["lpips"] == [None, None, None]


def test_a_channel_is_a_preset_a_scenario_or_a_section_alone(tmp_path: Path):
    assert read_channel("ch5") == ({"preset": "ch5"}, "ch5")
    (tmp_path / "delays.txt").write_text("10\n20\n")
    section = {"service": "trace:delays.txt", "discipline": "fcfs"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(section))
    found, name = read_channel(str(tmp_path / "mine.yaml"))
    assert name == "mine" and found["service"] == f"trace:{tmp_path / 'delays.txt'}"
    (tmp_path / "whole.yaml").write_text(yaml.safe_dump({**RAW, "channel": section}))
    assert read_channel(str(tmp_path / "whole.yaml"))[0] == found
    (tmp_path / "wrong.yaml").write_text("{discipline: sometimes}")
    for text in (str(tmp_path / "wrong.yaml"), str(tmp_path / "none.yaml"), "sms"):
        with pytest.raises(ScenarioError, match="--channel"):
            read_channel(text)


def test_the_command_compares_and_goes_on(tmp_path: Path, capsys, monkeypatch):
    monkeypatch.setattr(compare, "LEAD_S", 0.6)
    edge = {**RAW["edge"], "steps": 2, "updates": "arrivals", "update_ms": 50, "compute": {"ms_per_step": 2.0}}
    scenario, out = tmp_path / "small.yaml", tmp_path / "scores.json"
    scenario.write_text(yaml.safe_dump({**RAW, "edge": edge}))
    words = [str(scenario), "all", "freshest-k:2", "--seeds", "2", "--seconds", "0.5", "--jobs", "1"]
    words += ["--json", str(out), "--results", str(tmp_path / "known.jsonl"), "--channel", "ch6-slow"]
    monkeypatch.setattr("edge_server.embed.make_embedder", lambda _: pytest.fail("no policy looks at embeddings"))
    assert compare.main(words) == 0
    printed = capsys.readouterr().out
    assert "freshest-k:2" in printed and "minus all" in printed
    found = json.loads(out.read_text())
    assert found["compute"]["ms_per_step"] == 2.0 and found["policies"]["freshest-k:2"]["views"][0] <= 2.0
    assert found["policies"]["all"]["psnr_db"][0] > 5.0
    known = (tmp_path / "known.jsonl").read_bytes()
    assert compare.main(words) == 0 and (tmp_path / "known.jsonl").read_bytes() == known
