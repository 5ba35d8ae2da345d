from __future__ import annotations

import json

from edge_server.live.output.journal import Journal
from edge_server.live.state import Publication
from tests.freshfield.test_files import no_file_longer_than


def publication(number: int, psnr: float | None = None) -> Publication:
    return Publication(number, number / 2, number, None, ("cam01",), (10.0,), 10.0, 500.0, psnr_db=psnr)


def lines(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_series_keeps_the_order_of_publication_and_waits_for_scores(tmp_path):
    journal = Journal(tmp_path, dict)
    for i in range(3):
        journal.published(publication(i))
    journal.scored(publication(1, 21.0), final=True)  # out of order: number 0 is still open
    assert lines(tmp_path / "series.jsonl") == []
    journal.scored(publication(0, 20.0), final=True)
    journal.close()
    assert [(s["number"], s["psnr_db"]) for s in lines(tmp_path / "series.jsonl")] == [(0, 20.0), (1, 21.0), (2, None)]


def test_a_score_that_never_comes_holds_nothing_up(tmp_path):
    journal = Journal(tmp_path, dict)
    for i in range(100):
        journal.published(publication(i))
    assert len(lines(tmp_path / "series.jsonl")) == 68
    journal.close()
    assert len(lines(tmp_path / "series.jsonl")) == 100


def test_status_and_ages_are_json_with_nulls_not_nan(tmp_path):
    journal = Journal(tmp_path, lambda: {"updates": {"count": 3}})
    journal.ages(0.25, {"cam01": 12.3456, "cam02": None})
    journal.ages(0.5, {"cam01": 12.0}, {"cam01": 212.3456})
    journal.close()
    assert json.loads((tmp_path / "edge.json").read_text()) == {"updates": {"count": 3}}
    without_depth, with_depth = lines(tmp_path / "ages.jsonl")
    assert without_depth == {"t_s": 0.25, "age_ms": {"cam01": 12.346, "cam02": None}}
    assert with_depth == {"t_s": 0.5, "age_ms": {"cam01": 12.0}, "depth_age_ms": {"cam01": 212.346}}


def test_a_full_disk_costs_lines_not_the_edge(tmp_path, caplog):
    journal = Journal(tmp_path, lambda: {"filling": "x" * 1000, "lines_lost": journal.lines_lost})
    with no_file_longer_than(0):
        for i in range(44):
            journal.published(publication(i))
            journal.ages(i, {"cam01": 1.0})
            journal.write_status()
        journal.scored(publication(12, 20.0), final=True)
    assert journal.lines_lost == 13 + 44
    assert sum("edge.json" in record.message for record in caplog.records) == 1
    assert len(caplog.records) == 3  # one a file
    journal.close()  # there is space again
    assert json.loads((tmp_path / "edge.json").read_text())["lines_lost"] == 57
    assert len(lines(tmp_path / "series.jsonl")) == 31
