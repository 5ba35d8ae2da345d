"""What a live edge writes and tells, and never waits: journal and recording, whatever the disk; metrics."""

import json
import re
import threading
from collections import Counter, deque
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest
from prometheus_client import CollectorRegistry, generate_latest

from edge_server.live.ingest import DepthArrivals
from edge_server.live.output.journal import Journal
from edge_server.live.output.prometheus import EdgeCollector
from edge_server.live.output.recorder import Recorder
from edge_server.live.state import CameraView, Publication
from freshfield.frame import to_request
from tests.conftest import ROOT
from tests.edge_server.frames import frame
from tests.edge_server.page.preview import bare_state
from tests.freshfield.test_ledger import no_file_longer_than


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
    journal.ages(0.25, {"cam01": 12.3456, "cam02": None}, {"cam01": 212.3456})
    journal.close()
    age = {"t_s": 0.25, "age_ms": {"cam01": 12.346, "cam02": None}, "depth_age_ms": {"cam01": 212.346}}
    assert lines(tmp_path / "ages.jsonl") == [age]
    assert [(s["number"], s["psnr_db"]) for s in lines(tmp_path / "series.jsonl")] == [(0, 20.0), (1, 21.0), (2, None)]


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


class Growing(Counter):
    """Rejections of which a new reason arrives with every one that is read."""

    def items(self):
        for item in super().items():
            self[f"after {item[0]}"] += 1
            yield item


def ingest(rejected, depth=None):
    return SimpleNamespace(rejected=rejected, depth=depth or {}, buffer=SimpleNamespace(shed=2), check_ms=deque([1.0]))


def test_a_reason_that_comes_while_metrics_are_read_does_not_fail_them():
    found = {metric.name: metric for metric in EdgeCollector(bare_state(), ingest(Growing(crc=4, stale=1))).collect()}
    rejected = {s.labels["reason"]: s.value for s in found["freshfield_frames_rejected"].samples}
    assert rejected == {"crc": 4.0, "stale": 1.0}
    assert not any("depth" in name for name in found)


def test_every_query_of_the_dashboard_names_a_metric_that_the_edge_exports():
    state = bare_state()
    state.cameras = lambda: [CameraView("cam01", False, None, 12.0, 3, 0)]
    scores = {"psnr_db": 20.0, "psnr_moving_db": 15.0, "ssim": 0.8, "lpips": 0.2, "scored_on": "cam00"}
    state.publish(Publication(3, 1.5, 10**9, None, ("cam01",), (10.0,), 15.0, 5.0, **scores), None)
    registry = CollectorRegistry()
    depth = {"cam01": DepthArrivals(3, 2500, state.now_ns())}
    registry.register(EdgeCollector(state, ingest({"crc": 4}, depth)))
    text = generate_latest(registry).decode()
    exported = set(re.findall(r"^(\w+)[{ ]", text, re.MULTILINE)) - {"#"}
    values = {name: float(value) for name, value in re.findall(r"^freshfield_(\w+?)(?:{.*})? (\S+)$", text, re.M)}
    seconds = {"camera_age": 0.012, "update": 0.005, "aaoi": 0.015, "check": 0.001}
    counts = {"updates_total": 4, "selected_views": 1, "frames_delivered_total": 3, "frames_shed_total": 2}
    wanted = {f"{name}_seconds": value for name, value in seconds.items()} | counts
    assert {name: values[name] for name in wanted} == pytest.approx(wanted)
    dashboard = json.loads((ROOT / "deploy/grafana.json").read_text())
    queries = [target["expr"] for panel in dashboard["panels"] for target in panel["targets"]]
    queries.append(dashboard["templating"]["list"][0]["query"]["query"])
    asked = set()
    for query in queries:
        names = set(re.findall(r"\bfreshfield_\w+", query))
        assert names and names <= exported, query
        asked |= names
    assert asked == exported, "each metric is drawn"
    places = [tuple(panel["gridPos"][k] for k in "xywh") for panel in dashboard["panels"]]
    assert len({(x, y) for x, y, *_ in places}) == len(places) and all(x + w <= 24 for x, _, w, _ in places)


PUBLICATION = Publication(3, 1.5, 10**9, None, ("cam01", "cam02"), (10.0, 20.0), 15.0, 5.0, 7, 0.25)
SENT = [(to_request(frame("cam01", number)), number) for number in range(40)]


@pytest.fixture
def mcap(tmp_path):
    """The file of a recording."""
    pytest.importorskip("mcap", reason="MCAP is not installed (extra mcap)")
    return tmp_path / "a.mcap"


def test_what_finds_no_room_in_a_recording_is_dropped_and_counted_and_nobody_waits(mcap, monkeypatch):
    from freshfield.session.reader import Session

    monkeypatch.setattr("edge_server.live.live_constants.MOST_QUEUED", 10)
    recorder = Recorder(mcap, "test")
    stuck, go_on = threading.Event(), threading.Event()
    write = recorder._writer.frame

    def slow_disk(request, arrived_ns: int) -> None:
        stuck.set()
        assert go_on.wait(10)
        write(request, arrived_ns)

    recorder._writer.frame = slow_disk
    recorder.frame(*SENT[0])
    assert stuck.wait(10)
    for message in SENT[1:]:
        recorder.frame(*message)
    assert recorder.dropped == len(SENT) - 1 - 10
    go_on.set()
    recorder.close()
    session = Session(mcap)
    kept = [(f.arrived_ns, session.payload(f)) for f in session.frames["cam01"]]
    assert kept == [(number, request.payload) for request, number in SENT[:11]]


def test_a_full_disk_ends_the_recording_and_nothing_else(mcap, caplog):
    recorder = Recorder(mcap, "test")
    recorder._writer.frame = MagicMock(side_effect=OSError(28, "No space left on device"))
    for message in SENT[:6]:
        recorder.frame(*message)
    recorder.close()
    assert "recording ended: [Errno 28] No space left" in caplog.text
    assert recorder.status() == {"file": "a.mcap", "written": 0, "dropped": 6, "failed": True}
    recorder.published(PUBLICATION)
    assert recorder.dropped == 7


def test_grafana_reads_all_of_the_dashboard():
    """Grafana's published types leave out what they do not know; ``__inputs`` is for its import alone."""
    models = pytest.importorskip("grafana_foundation_sdk.models.dashboard", reason="needs the extra dev")
    from grafana_foundation_sdk.cog.encoder import JSONEncoder

    dashboard = json.loads((ROOT / "deploy/grafana.json").read_text())
    read = json.loads(json.dumps(models.Dashboard.from_json(dashboard), cls=JSONEncoder))
    assert lost(dashboard, read) == ["/__inputs"]


def lost(sent: Any, read: Any, where: str = "") -> list[str]:
    """What of ``sent`` is not in ``read``, which may have more."""
    if isinstance(sent, dict) and isinstance(read, dict):
        return [each for k, v in sent.items() for each in lost(v, read.get(k), f"{where}/{k}")]
    if isinstance(sent, list) and isinstance(read, list) and len(sent) == len(read):
        return [each for k, pair in enumerate(zip(sent, read)) for each in lost(*pair, f"{where}/{k}")]
    return [] if sent == read else [where]
