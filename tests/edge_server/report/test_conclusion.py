"""The conclusion says what was measured, and what of it is no held-out view; events are found and marked."""

from __future__ import annotations

import json
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.fidelity.scorer import SELECTED
from edge_server.page import markup
from edge_server.report import figures
from edge_server.report.build_report import assemble
from edge_server.report.conclusion import conclusion
from edge_server.report.events import silences
from edge_server.report.run_files import read_run_files
from edge_server.run_records import AgesRow
from freshfield.scenario import NOTHING_HELD_OUT
from freshfield_up.status import _edge_line
from freshfield_up.summary import summarize
from tests.edge_server.page.test_markup import summary
from tests.edge_server.report.sample_run import CHANNEL, EDGE, page_of, write_run

SO_FAR = {"now_psnr_db": 20.0, "all_psnr_db": 23.0, "frames": 9}
TRAINED_ON = {"fidelity.scored_on": ["selected"], "fidelity.final.psnr_db": 17.4, "fidelity.shown.psnr_db": None}


@pytest.fixture
def report(tmp_path: Path) -> dict[str, Any]:
    write_run(tmp_path, ages=20)
    return assemble(read_run_files(tmp_path))


def test_three_sentences_say_what_was_shown_its_age_and_its_limit(tmp_path: Path) -> None:
    write_run(tmp_path)
    report, page = page_of(tmp_path)
    shown, age, limit = report["conclusion"]
    assert shown == (
        "In the last fifth of the run, what was shown read 24.0 dB, 17.0 dB where the scene moves; "
        "an image of one mean color reads 14.5 dB."
    )
    assert "(50 ms network, " in age and age.endswith("reads 26.0 dB, 9.0 above what moves.")
    assert limit.startswith("Showing each image until the next was the limit")
    assert "50% of the frames sent did not pass" in limit
    assert " ".join(report["conclusion"]) in page


@pytest.mark.parametrize(
    ("changes", "sentence", "words"),
    [
        ({"updates.count": 0}, 0, "Nothing was shown: the field was never updated."),
        ({"fidelity.shown.psnr_db": 12.0}, 0, "worse than an image of one mean color, which reads 14.5 dB."),
        ({"fidelity.shown.psnr_db": None, "fidelity.final.psnr_db": None}, 0, "is not known"),
        ({"fidelity.so_far": SO_FAR}, 0, "all 9 so far 23.0 dB"),
        ({"fidelity.shown.age_ms.waiting": 0.0}, 2, "Waiting for an update and computing it were the limit"),
        ({"fidelity.shown.age_ms.display": 10.0}, 2, "The network was the limit: it takes the largest part"),
        ({"fidelity.shown.psnr_still_db": 15.0}, 2, "too few cameras"),
        ({**TRAINED_ON, "fidelity.shown.psnr_still_db": None}, 2, "poses that do not fit, or too short a run"),
        ({"fidelity.shown.psnr_still_db": 15.0, "fidelity.so_far": SO_FAR}, 2, "the limit: it takes"),
        ({"updates.without_step": 3, "updates.count": 50}, 2, "6% of the updates had no time for a step of training"),
        ({"updates.shed": 70}, 2, "92% of those delivered were left out for lack of time"),
    ],
)
def test_the_conclusion_follows_the_figures(report, changes, sentence, words) -> None:
    for path, value in changes.items():
        *parents, last = path.split(".")
        reduce(dict.__getitem__, parents, report)[last] = value
    assert words in conclusion(report)[sentence]


def test_events_of_operators_network_and_cameras_are_listed_in_order(tmp_path: Path) -> None:
    write_run(tmp_path)
    began_ns = 1_800_000_000_000_000_000
    told = {"started_ns": began_ns, "events": [{"t_s": 12.5, "what": "an operator reset the field"}]}
    (tmp_path / "edge.json").write_text(json.dumps(EDGE | told))
    by_hand = {"at_ns": began_ns + 9_000_000_000, "delay_ms": 200.0, "loss": 0.1}
    changes = {"changes": [by_hand, {"at_ns": began_ns + 20_000_000_000}]}
    (tmp_path / "channel.json").write_text(json.dumps(CHANNEL | changes))
    report, page = page_of(tmp_path)
    assert [(event["t_s"], event["what"]) for event in report["events"]] == [
        (9.0, "network set: 200 ms, 10 % lost"),
        (12.5, "an operator reset the field"),
        (20.0, "the scenario's network again"),
    ]
    assert "9.0 s: network set" in page


def test_cameras_that_fall_silent_together_are_one_event() -> None:
    """At 10 s cam01 to cam05 lose the network, all but cam05 until 16 s; cam00 goes on."""
    rows = []
    for t_s in np.arange(0.0, 30.0, 0.2):
        ages: dict[str, float | None] = {"cam00": 50.0, "never": None}
        for k in range(1, 6):
            away = t_s > 10.0 and (k == 5 or t_s < 16.0)
            ages[f"cam0{k}"] = 1e3 * (t_s - 10.0) if away else 50.0
        rows.append(AgesRow(float(t_s), ages))
    (gone,) = silences(rows)
    assert gone.t_s == pytest.approx(10.0, abs=0.01) and gone.what == "cam01, cam02, cam03 and 2 more: no further frame"
    (back,) = silences([AgesRow(row.t_s, {"cam01": row.age_ms["cam01"]}) for row in rows])
    assert back.what == "cam01: no frame for 5.9 s"


def run_of(folder: Path, scored_on: str) -> Path:
    """A run's folder in which every score is on ``scored_on``."""
    write_run(folder)
    lines = (json.loads(line) for line in (folder / "series.jsonl").read_text().splitlines())
    on = [line | {"scored_on": line["scored_on"] and scored_on} for line in lines]
    (folder / "series.jsonl").write_text("".join(json.dumps(line) + "\n" for line in on))
    return folder


def told(folder: Path, on: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """What each place that shows a fidelity says of it, where every score is on ``on``."""
    titles: list[str] = []
    monkeypatch.setattr(figures, "label_lines", lambda *_, title="", **__: titles.append(title))
    report, page = page_of(run_of(folder, on))
    figures.draw_fidelity(report, read_run_files(folder), folder / "fidelity.png")
    status = {"updates": {"count": 3, "ms_p50": 9.0}, "scores": {"psnr_db": 20.0, "on": on}}
    return {
        "page's tile": markup.status(summary(scored_on=on)),
        "page's pair": markup.comparison_caption("cam01", 20.0, 3, held_out=on != SELECTED),
        "report": page.split("<h2>Age")[0],
        "report's figure": titles[0],
        "console": _edge_line(status),
    }


def test_a_score_on_training_views_is_called_what_it_is(tmp_path, monkeypatch):
    selected, held_out = (told(tmp_path / name, name, monkeypatch) for name in (SELECTED, "cam00"))
    for place, words in selected.items():
        assert NOTHING_HELD_OUT in words and "present" not in words.lower(), place
        assert NOTHING_HELD_OUT not in held_out[place], place


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
