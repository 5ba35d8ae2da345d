"""The conclusion says what was measured, and names what limited it; events are found and marked."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.report.build_report import assemble
from edge_server.report.conclusion import conclusion
from edge_server.report.events import silences
from edge_server.report.run_files import read_run_files
from edge_server.run_records import AgesRow
from tests.edge_server.report.sample_run import CHANNEL, EDGE, page_of, write_run

SO_FAR = {"now_psnr_db": 20.0, "all_psnr_db": 23.0, "frames": 9}
TRAINED_ON = {"fidelity.scored_on": ["selected"], "fidelity.final.psnr_db": 17.4, "fidelity.shown.psnr_db": None}


@pytest.fixture
def report(tmp_path: Path) -> dict[str, Any]:
    write_run(tmp_path, ages=20)
    return assemble(read_run_files(tmp_path))


def change(report: dict[str, Any], path: str, value: Any) -> None:
    *parents, last = path.split(".")
    for name in parents:
        report = report[name]
    report[last] = value


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
        change(report, path, value)
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
