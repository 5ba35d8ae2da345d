"""Every place that shows a fidelity: with nothing held out each says so, and none speaks of the present."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from edge_server.fidelity.scorer import SELECTED
from edge_server.page import markup
from edge_server.report import figures
from edge_server.report.build_report import assemble
from edge_server.report.run_files import read_run_files
from freshfield.scenario import NOTHING_HELD_OUT
from freshfield_up.status import _edge_line
from freshfield_up.summary import summarize
from tests.edge_server.page.test_markup import summary
from tests.edge_server.report.sample_run import page_of, write_run


def run_of(folder: Path, scored_on: str) -> Path:
    """A run's folder in which every score is on ``scored_on``."""
    write_run(folder)
    lines = (json.loads(line) for line in (folder / "series.jsonl").read_text().splitlines())
    on = [line | {"scored_on": line["scored_on"] and scored_on} for line in lines]
    (folder / "series.jsonl").write_text("".join(json.dumps(line) + "\n" for line in on))
    return folder


def page_tile(folder: Path, on: str) -> str:
    return markup.status(summary(scored_on=on))


def page_pair(folder: Path, on: str) -> str:
    return markup.comparison_caption("cam01", 20.0, 3, held_out=on != SELECTED)


def report_page(folder: Path, on: str) -> str:
    return page_of(run_of(folder, on))[1].split("<h2>Age")[0]


def report_figure(folder: Path, on: str, monkeypatch: pytest.MonkeyPatch) -> str:
    titles: list[str] = []
    monkeypatch.setattr(figures, "label_lines", lambda *_, title="", **__: titles.append(title))
    files = read_run_files(run_of(folder, on))
    figures.draw_fidelity(assemble(files), files, folder / "fidelity.png")
    return titles[0]


def console_table(folder: Path, on: str) -> str:
    return _edge_line({"updates": {"count": 3, "ms_p50": 9.0}, "scores": {"psnr_db": 20.0, "on": on}})


@pytest.mark.parametrize("place", [page_tile, page_pair, report_page, report_figure, console_table])
def test_a_score_on_training_views_is_called_what_it_is(place, tmp_path, monkeypatch):
    more = (monkeypatch,) if place is report_figure else ()
    selected, held_out = place(tmp_path / "a", SELECTED, *more), place(tmp_path / "b", "cam00", *more)
    assert NOTHING_HELD_OUT in selected and "present" not in selected.lower()
    assert NOTHING_HELD_OUT not in held_out


def test_the_age_of_what_was_shown_is_told_without_a_held_out_camera(tmp_path):
    folder = run_of(tmp_path, SELECTED)
    (folder / "shown.jsonl").unlink()
    lines = [json.loads(line) | {"network_ms": 50.0} for line in (folder / "series.jsonl").read_text().splitlines()]
    (folder / "series.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    report, page = page_of(folder)
    age = report["fidelity"]["shown"]["age_ms"]
    # Updates of some 745 ms follow each other: an image is shown for 750, and counts as old as it is in the middle.
    assert age["network"] == 50.0 and age["computing"] == pytest.approx(757, abs=20)
    assert age["display"] == pytest.approx(375, abs=40)
    assert "(50 ms network, " in summarize(folder)
    assert "ms network" in page
