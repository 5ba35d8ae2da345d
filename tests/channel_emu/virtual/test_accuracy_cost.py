"""The measuring commands: their peers agree with theory and with the links, and their tables add up."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

pytest.importorskip("numba", reason="the tables are measured on the numba kernel")
pytest.importorskip("scipy", reason="the tables' intervals need scipy")

from channel_emu.cli import main
from channel_emu.model.faults import NAMES
from channel_emu.virtual import accuracy_cost
from channel_emu.virtual.benchmark import FAULTS, bench_cost, bench_simulate


def test_bench_simulate_compares_like_with_like() -> None:
    found = bench_simulate(6, 60.0, 2, loop_seconds=60.0)
    assert found["mean_age_ms"] == pytest.approx(found["loop_mean_age_ms"], rel=0.05)
    ours, loop = (found[f"{name}_million_link_slots_per_s"] for name in ("decisions_and_ages", "plain_loop"))
    ratio = ours / loop
    assert found["times_the_loop"] == pytest.approx(ratio) and ratio > 1


def test_the_cost_table_names_every_fault() -> None:
    assert set(FAULTS) == set(NAMES)
    rows = bench_cost(frames=200, rounds=5)
    assert rows[0]["what"] == "ideal link" and rows[0]["added_ns"] == 0
    assert {f"fault {name}" for name in NAMES} <= {row["what"] for row in rows}
    # Looking up a random number in Python is work that no noise hides.
    assert next(row for row in rows if row["what"] == "fault loss")["added_ns"] > 0


def test_longer_runs_err_less() -> None:
    rows = accuracy_cost.duration(8, 320.0)
    errors = [row["rms_error_pct"] for row in rows]
    assert errors[0] > 2 * errors[2] > 4 * errors[-1]
    assert rows[-1]["seconds"] == pytest.approx(316.2, abs=0.1)


def test_the_measured_bias_of_slots_is_the_exact_one() -> None:
    rows = accuracy_cost.chain_slots(5, 30_000)
    assert {row["slot_ms"] for row in rows if row["what"] == "chain fast"} >= {0.0, 0.2, 2.0}
    for row in rows:
        error = abs(row["bias_measured_pct"] - row["bias_exact_pct"])
        assert error < 3 * row["half_width_pct"]
    assert max(row["bias_exact_pct"] for row in rows) > 50  # and there is a bias to measure


@pytest.mark.slow
def test_the_command_writes_tables_and_figure(tmp_path: Path, capsys) -> None:
    assert main(["accuracy", "--quick", "--out", str(tmp_path)]) == 0
    text = capsys.readouterr().out
    assert "rms error" in text and "chain thesis" in text
    for name in ("duration", "slots"):
        with (tmp_path / f"accuracy-{name}.csv").open() as file:
            assert len(list(csv.DictReader(file))) >= 3
    assert (tmp_path / "accuracy.png").read_bytes().startswith(b"\x89PNG")


def test_commands_print_json(capsys, monkeypatch) -> None:
    monkeypatch.setattr("channel_emu.virtual.benchmark.bench_cost", lambda: [{"what": "x"}])
    assert main(["bench", "--cost", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == [{"what": "x"}]
    words = ["simulate", "--preset", "ch5", "--discipline", "newest-waits", "--spread", "--cameras", "6", "--json"]
    ages = []
    for more in ([], ["--shared-server"]):
        assert main([*words, "--seconds", "60", *more]) == 0
        ages.append(json.loads(capsys.readouterr().out)["mean_age_ms"])
    assert ages[1] > 2 * ages[0]  # six cameras wait for one line
    assert (
        main(["simulate", "--preset", "ch6", "--chain", "mu1=1/30,mu2=1/30,slots=5ms", "--seconds", "20", "--json"])
        == 0
    )
    assert sum(json.loads(capsys.readouterr().out)["state_share"].values()) == pytest.approx(1)
