"""Studies of what learns, run whole on a small world: tables, figures, verdicts, resuming."""

from __future__ import annotations

import csv
from pathlib import Path

import pytest

from edge_server.offline.study import learning
from edge_server.offline.study.base import Ask
from edge_server.offline.study.command import LEARNING, make_study
from edge_server.offline.study.learning import better, no_worse
from edge_server.offline.study.trial import Folders
from tests.edge_server.offline.training.small import FIELD

SMALL = {"steps": 3, "decisions": 1, "lead_ms": 800.0, "span_ms": 400.0}


@pytest.fixture
def small(monkeypatch):
    """Every setting small, every training short; what is asked of them stays as it is."""
    usual = learning.room

    def room(*args, **more):
        return usual(*args, **{**more, **SMALL})

    monkeypatch.setattr(learning, "SIZE", 24)
    monkeypatch.setattr(learning, "FIELD_OPTIONS", FIELD)
    for name in LEARNING:
        module = f"edge_server.offline.study.{name.replace('-', '_')}"
        monkeypatch.setattr(f"{module}.room", room)
        monkeypatch.setattr(f"{module}.EPISODES", {True: 3, False: 3})
    monkeypatch.setattr("edge_server.offline.study.drift.BEFORE", 2)
    monkeypatch.setattr("edge_server.offline.study.drift.AFTER", 22)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNING)
def test_a_study_runs_to_its_verdicts_and_goes_on_from_what_it_has(name, small, tmp_path: Path, capsys):
    ask = Ask(True, tmp_path, Folders(), seeds=2)
    study = make_study(name)
    assert study.points(ask) == []
    first = study.report(ask, None)
    assert first and all(v.line() for v in first)
    rows = list(csv.DictReader((tmp_path / f"{name}.csv").open()))
    assert rows and all(row["reward"] for row in rows)
    assert list(tmp_path.glob(f"{name}*.png"))
    lines = (tmp_path / "training/evaluations.jsonl").read_text().count("\n")
    again = make_study(name).report(ask, None)
    assert [(v.about, v.claim, v.verdict) for v in again] == [(v.about, v.claim, v.verdict) for v in first]
    assert (tmp_path / "training/evaluations.jsonl").read_text().count("\n") == lines
    capsys.readouterr()


def test_verdicts_follow_from_the_paired_differences():
    base = {s: 1.0 + 0.1 * s for s in range(8)}
    up, down = ({s: v + d + 0.001 * (s % 3) for s, v in base.items()} for d in (0.2, -0.2))
    same = {s: v + 0.001 * (-1) ** s for s, v in base.items()}
    assert [better("a", "b", x, base).verdict for x in (up, down, same)] == [
        "holds", "does not hold", "undecided"
    ]  # fmt: skip
    assert [no_worse("a", "b", x, base).verdict for x in (up, down, same)] == [
        "holds", "does not hold", "holds"
    ]  # fmt: skip
