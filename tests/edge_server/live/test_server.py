"""A whole edge server in one process: real gRPC, a real (small) field, real scores."""

from __future__ import annotations

import json
import os
import signal
import socket
import threading
import time
import urllib.request
from contextlib import suppress
from importlib import resources
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import grpc
import numpy as np
import pytest

from edge_server.cli import main as edge_server
from edge_server.edge_constants import CARRIED_OPTIONS
from edge_server.fields import checkpoint
from edge_server.fields.registry import make_field
from edge_server.fields.splat.carried_camera.carried_field import CarriedField
from edge_server.live.live_constants import AGES_PERIOD_S, MAX_SCRAPES, MAX_SNAPSHOTS, MAX_WATCHERS, STOP_S
from edge_server.live.loop import UpdateLoop
from edge_server.live.server import EdgeServer, ServerOptions
from edge_server.scheduler.learned.actor import Actor
from edge_server.scheduler.learned.decision_record import read_decision
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.networks import init_actor
from edge_server.scheduler.learned.state import StateLayout
from edge_server.settings import read_config
from freshfield import scenario
from freshfield.frame import to_request
from freshfield.geometry import Pose, look_at
from freshfield.ledger import read_all
from freshfield.transport import Transport, TransportError
from freshfield.v1 import clock_pb2, clock_pb2_grpc, edge_pb2, edge_pb2_grpc, frames_pb2, frames_pb2_grpc
from freshfield_up.launcher_constants import GRACE_S
from tests.edge_server.frames import TINY, frame
from tests.support import free_port, refused, wait_until


def tiny_scenario(tmp_path, **edge):
    edge = {"field": "ngp", "field_options": TINY, "update_ms": 100, "grace_ms": 500, "lpips": "none", **edge}
    data = {"name": "tiny", "seed": 3, "cameras": {"count": 3, "held_out": ["cam00"]}, "edge": edge}
    return scenario.parse(data, tmp_path / "tiny.yaml")


class Run:
    """A server on a thread, and a stream of frames to it."""

    def __init__(self, made: scenario.Scenario, out: Path, **options: Any) -> None:
        self.port, self.scenario = free_port(), made
        self.server = EdgeServer(made, read_config(made), ServerOptions(f"127.0.0.1:{self.port}", out, **options))
        self.thread = threading.Thread(target=self.server.run)
        self.thread.start()
        self.done, self.answers = threading.Event(), []
        self.feed = threading.Thread(target=self.push, daemon=True)
        self.moving = ""

    def frames(self):
        for sequence, (k, camera) in product(range(10**4), enumerate(self.scenario.cameras)):
            if self.done.wait(0.01):
                return
            turned = 0.5 * k + 0.1 * sequence * (camera == self.moving)
            pose = Pose.from_matrix(look_at([2 * np.cos(turned), 2 * np.sin(turned), 0.5], [0, 0, 0]))
            held_out = camera in self.scenario.held_out
            yield to_request(frame(camera, sequence, time.time_ns(), pose=pose, held_out=held_out))

    def push(self) -> None:
        with Transport().channel(f"127.0.0.1:{self.port}") as channel, suppress(grpc.RpcError):  # the server stops
            push = frames_pb2_grpc.FrameStreamServiceStub(channel).Push
            self.answers.extend(push(self.frames(), wait_for_ready=True))

    def fed(self, moving: str = "") -> Run:
        """Fed with real frames, one unacknowledged at a time, until it shows something, and on."""
        self.moving = moving
        self.feed.start()
        until(self.server.state.publications)
        return self

    def end(self) -> None:
        self.done.set()
        if self.feed.is_alive():
            self.feed.join(5)
        self.server.stop()
        self.thread.join(20)
        assert not self.thread.is_alive()


@pytest.fixture
def serve(tmp_path):
    runs = []

    def start(made=None, **options):
        runs.append(Run(made or tiny_scenario(tmp_path), tmp_path / "out", **options))
        return runs[-1]

    yield start
    for run in runs:
        run.end()


def connected(run: Run) -> grpc.Channel:
    channel = Transport().channel(f"127.0.0.1:{run.port}")
    grpc.channel_ready_future(channel).result(30)
    return channel


def until(condition, seconds=60.0):
    wait_until(condition, "it never happened", seconds)


def test_a_run_from_first_frame_to_files(serve, tmp_path):
    run = serve(metrics_port=(metrics := free_port())).fed()
    server = run.server
    until(lambda: any(p.psnr_db is not None for p in server.state.publications()))
    until(lambda: server.scoring.baselines.mean.mean_color_db)  # they come after the first score
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics") as page:
        text = page.read().decode()
    assert 'freshfield_camera_age_seconds{camera="cam01"}' in text
    assert "freshfield_psnr_db" in text and "freshfield_updates_total" in text
    server.loop.without_step += 1000  # on a machine that is too slow
    server.buffer.shed += 7
    server.state.note("an operator reset the field")
    run.end()
    out = tmp_path / "out"
    series = [json.loads(line) for line in (out / "series.jsonl").read_text().splitlines()]
    scored = [s for s in series if s["psnr_db"] is not None]
    assert scored and all(abs(s["truth_gap_ms"]) < 100 for s in scored)
    assert {c for s in series for c in s["selected"]} == {"cam01", "cam02"}  # never the held-out one
    status = json.loads((out / "edge.json").read_text())
    assert status["updates"]["count"] == len(series)
    assert status["baseline"]["mean_color_db"] > 5
    assert (out / "truth.png").exists() and (out / "rendered.png").exists()
    (ledger,) = read_all(out)
    delivered = [e for e in ledger.events if e.event == "delivered"]
    assert ledger.closed and len(delivered) == len(run.answers)

    # And it goes on from there.
    again = serve(resume=out / "field.npz").server
    assert again.updater.field.step > 0 and again.updater.number == len(series)
    assert again.loop.without_step == server.loop.without_step >= 1000
    known = again.ingest.admission.last_frames()
    last = {camera: max(e.sequence for e in delivered if e.camera == camera) for camera in server.scenario.cameras}
    assert {camera: known[camera]["s1"][0] for camera in known} == last
    fresh = serve().server
    assert fresh.updater.number == 0 and not fresh.state.started
    (event,) = fresh.status()["events"]  # of the first process, before this one
    assert event["what"] == "an operator reset the field" and -60 < event["t_s"] <= 0
    counted = fresh.status()["updates"]  # those of the first process, as in the ledgers, too
    assert counted["shed"] >= 7 and counted["without_step"] >= 1000 and counted["count"] >= len(series)
    kept = [json.loads(line) for line in (out / "series.jsonl").read_text().splitlines()]
    assert kept[: len(series)] == series  # what the first process wrote is still there


def test_a_run_is_recorded_with_its_frames_decisions_and_scores(serve, tmp_path):
    pytest.importorskip("mcap", reason="MCAP is not installed (extra mcap)")
    from freshfield.session import reader

    run = serve(record=tmp_path / "b.mcap").fed()
    until(lambda: any(p.psnr_db is not None for p in run.server.state.publications()))
    run.end()
    status, found = json.loads((tmp_path / "out/edge.json").read_text()), reader.Session(tmp_path / "b.mcap")
    written = found.messages.total()
    assert status["recording"] == {"file": "b.mcap", "written": written, "dropped": 0, "failed": False}
    assert sum(map(len, found.frames.values())) == len(run.answers) and found.cut is None
    assert 0 < found.messages["/scores"] <= found.messages["/decisions"] == status["updates"]["count"]


def test_operators_see_and_change_a_running_server(serve):
    run = serve()
    server, channel = run.server, connected(run)
    edge = edge_pb2_grpc.EdgeServiceStub(channel)
    early = edge.SaveSnapshot.future(edge_pb2.SaveSnapshotRequest())
    assert early.code() == grpc.StatusCode.FAILED_PRECONDITION
    run.fed()
    decisions = edge.WatchDecisions(edge_pb2.WatchDecisionsRequest())
    first = next(decisions).decision
    assert set(first.selected) <= {"cam01", "cam02"}
    assert first.published_ns - first.decided_ns == round(first.update_ms * 1e6)
    status = edge.GetStatus(edge_pb2.GetStatusRequest())
    assert [c.camera_id for c in status.cameras if c.held_out] == ["cam00"]
    changed = edge.SetPolicy(edge_pb2.SetPolicyRequest(name="threshold", value=77.0))
    assert (changed.name, changed.value) == ("threshold", 77.0)
    assert edge.SetPolicy(edge_pb2.SetPolicyRequest(value=78.0)).value == 78.0, "of the policy in force"
    until(lambda: server.state.publications()[-1].omega_ms == 78.0)
    unknown = edge.SetPolicy.future(edge_pb2.SetPolicyRequest(name="best"))
    assert unknown.code() == grpc.StatusCode.INVALID_ARGUMENT and "freshest-k" in unknown.details()
    assert checkpoint.load(edge.SaveSnapshot(edge_pb2.SaveSnapshotRequest()).path)[0]
    edge.ResetField(edge_pb2.ResetFieldRequest())
    until(lambda: not server.state.controls.reset_requested)
    answer = clock_pb2_grpc.ClockServiceStub(channel).Exchange(clock_pb2.ExchangeRequest(client_sent_ns=5))
    assert answer.client_sent_ns == 5
    assert answer.server_sent_ns >= answer.server_received_ns
    decisions.cancel()
    channel.close()


def test_a_camera_that_moves_begins_the_field_anew_as_a_scan_and_a_resumed_run_knows_it(serve, tmp_path):
    small = {"gaussians": 300, "start": 200, "seed_cells": 12}
    for kind in ({"layers": True}, CARRIED_OPTIONS):  # compiling may take longer than the test waits for anything
        make_field("splat", {**kind, **small}).warm_up()
    known = json.loads(resources.files("edge_server").joinpath("frontier.json").read_text())["updates"]
    own = {"updates": [row for row in known if row["options"].get("layers")]}  # knows the first choice only
    (tmp_path / "own.json").write_text(json.dumps(own))
    made = tiny_scenario(tmp_path, field="splat", field_options=small, frontier="own.json")
    run = serve(made)
    server = run.server
    said = "splat in layers, updated at arrivals for 100 ms: no camera moves; the scenario sets field, update_ms"
    assert server.state.chosen == said
    run.fed(moving="cam02")
    until(lambda: "cam02 moves" in server.state.chosen)
    moved = server.updater.number
    until(lambda: server.updater.number > moved + 1)
    assert server.updater.keyframes is None and not server.updater.on_arrivals
    assert isinstance(server.updater.field, CarriedField)
    assert not server.updater.field.frame_s and server.loop.update_ms == 100.0
    pool, workers = server.updater.field.pool, set[int]()
    pool.run(lambda counter, worker: workers.add(worker))
    assert workers == set(range(pool.threads)), "layers have given theirs back"
    run.end()
    status = json.loads((tmp_path / "out" / "edge.json").read_text())
    assert status["chosen"].startswith("splat as a scan, updated in a cycle for 100 ms: cam02 moves")
    again = serve(made, resume=tmp_path / "out" / "field.npz").server
    assert again.state.chosen == status["chosen"] and len(again.updater.field.views) > 0


def test_metrics_hold_few_connections_and_answer_beside_half_requests(serve):
    server = serve(metrics_port=(metrics := free_port())).server
    until(lambda: server.loop.alive)
    server.buffer.shed = 3
    half = []
    for _ in range(100):
        half.append(socket.create_connection(("127.0.0.1", metrics)))
        half[-1].sendall(b"GET /metrics HTTP/1.1\r\n")
    with urllib.request.urlopen(f"http://127.0.0.1:{metrics}/metrics", timeout=10) as page:
        text = page.read()
    assert b"freshfield_frames_rejected" in text and b"freshfield_frames_shed_total 3.0" in text
    assert server.status()["updates"]["shed"] == 3
    # At once, and not only when the silent ones time out.
    until(lambda: sum("process_request" in t.name for t in threading.enumerate()) <= MAX_SCRAPES, 2.0)
    for connection in half:
        connection.close()


def test_watchers_are_few_and_a_new_one_always_finds_a_place(serve):
    with connected(serve()) as channel:
        edge = edge_pb2_grpc.EdgeServiceStub(channel)
        watching = [edge.WatchDecisions(edge_pb2.WatchDecisionsRequest()) for _ in range(MAX_WATCHERS + 20)]
        until(lambda: sum(call.done() for call in watching) == 20)
        assert watching[0].code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert not watching[-1].done()


def test_snapshots_do_not_fill_the_disk(serve, tmp_path):
    run = serve(checkpoint_s=0.0)
    waiting = run.server.loop._checkpoints.qsize
    until(waiting)
    time.sleep(3 * AGES_PERIOD_S)
    assert waiting() == 1, "nobody has sent anything, for hours"
    server = run.fed().server
    with server._snapshot_lock, pytest.raises(RuntimeError, match="another one is being written"):
        server.state.save_snapshot()
    server.state.save_snapshot()
    for k in range(MAX_SNAPSHOTS - 1):
        (tmp_path / "out" / f"snapshot-9{k:05d}.npz").touch()
    refused(RuntimeError, "holds 20 already: move some away", server.state.save_snapshot)


def test_a_token_is_demanded_and_honoured(serve):
    secured = Transport(tokens={"camera:*": "open sesame"})
    with connected(serve(transport=secured)) as channel:
        push, sent = frames_pb2_grpc.FrameStreamServiceStub(channel).Push, to_request(frame("cam01", 0, time.time_ns()))
        assert push(iter([sent])).code() == grpc.StatusCode.UNAUTHENTICATED
        assert next(push(iter([sent]), metadata=secured.metadata())).outcome == frames_pb2.OUTCOME_ACCEPTED


def test_every_port_beyond_this_machine_is_protected_or_named(tmp_path):
    made = tiny_scenario(tmp_path)

    def server(**options):
        ports = {"page_host": "0.0.0.0", "open_page": lambda state: pytest.fail("opened"), "metrics_port": 0}
        return EdgeServer(made, read_config(made), ServerOptions("0.0.0.0:0", tmp_path / "o", **ports, **options))

    pytest.importorskip("mcap", reason="needs the extra mcap")
    refused(TransportError, r"cannot listen: gRPC on 0\.0\.0\.0", server(record=tmp_path / "s.mcap").run)
    page = ServerOptions("127.0.0.1:0", tmp_path / "o", open_page=MagicMock(side_effect=OSError("taken")))
    refused(OSError, "taken", EdgeServer(made, read_config(made), page).run)
    # A start that fails is no process that was killed, takes no name, and leaves an earlier run's status and frontier.
    assert not read_all(tmp_path / "o") and not [*tmp_path.glob("*.mcap"), *tmp_path.glob("o/*.json")]
    late = EdgeServer(made, read_config(made), page)
    late.ledger.write(1, "cam01", "s", 0, "delivered")  # before the page was opened
    refused(OSError, "taken", late.run)
    (ledger,) = read_all(tmp_path / "o")
    assert ledger.path.name == f"ledger-edge-unserved-{late.start_ns}.tsv" and len(list(ledger)) == 2
    named = server(transport=Transport(insecure=True))._warnings()
    assert [words.split(" on ")[0] for words in named] == ["gRPC", "page", "metrics"]


def test_the_ledger_is_closed_even_if_nothing_else_can_be_written(serve, tmp_path):
    run = serve().fed()
    (tmp_path / "out" / "field.npz").mkdir()  # the checkpoint cannot take its place
    run.end()
    (ledger,) = read_all(tmp_path / "out")
    assert ledger.closed
    assert json.loads((tmp_path / "out" / "edge.json").read_text())["lines_lost"] == 0


def test_files_are_written_before_anything_that_may_take_long(serve, tmp_path, monkeypatch):
    closed = []

    def page_stops() -> None:
        (ledger,) = read_all(tmp_path / "out")
        closed.append(ledger.closed)

    run = serve(open_page=lambda state: SimpleNamespace(url="here", stop=page_stops)).fed()
    written, stop = [], run.server.scoring.stop

    def scoring_stops(*given) -> None:
        written.append((tmp_path / "out/field.npz").exists())
        stop(*given)

    monkeypatch.setattr(run.server.scoring, "stop", scoring_stops)
    run.end()
    assert written == [True] and closed == [True]
    assert STOP_S <= GRACE_S - 10.0, "the launcher would kill it before"


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGINT])
def test_a_closed_terminal_and_an_interrupt_in_a_scripts_background_end_the_run(number, tmp_path, monkeypatch):
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # as a shell starts it there
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # under nohup, tests ignore it

    def closed(server):
        os.kill(os.getpid(), number)
        assert server._stopping.wait(5)

    monkeypatch.setattr(EdgeServer, "run", closed)
    # A first start under a supervisor: what it will resume from is not there yet.
    words = ["run", "room", "--out", str(tmp_path / "out"), "--page-port", "0", "--resume"]
    try:
        assert edge_server([*words, str(tmp_path / "out/field.npz")]) == 0
        assert edge_server([*words, str(tmp_path / "other/field.npz")]) == 2
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def test_a_learned_policy_decides_by_what_cameras_see_and_its_decisions_are_kept(serve, tmp_path):
    pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
    pytest.importorskip("onnx", reason="the extra embed is not installed")
    from tests.edge_server.embed.graphs import CHANNELS, detector

    detector(tmp_path / "d.onnx")
    spec = Spec("select", StateLayout(("age", "semantics"), dim=CHANNELS))
    Actor(spec, init_actor(spec, np.random.default_rng(1))).save(tmp_path / "policy.npz")
    embedding = {"model": "d.onnx", "dim": CHANNELS}
    run = serve(tiny_scenario(tmp_path, policy={"name": "bandit:policy.npz"}, embedding=embedding)).fed()
    server = run.server
    until(lambda: server.updater.number >= 4)
    run.end()
    found = read_decision(tmp_path / "out", 1).decision
    used = [c for c, chosen in zip(found.state.cameras, found.action) if chosen]
    assert list(next(p for p in server.state.publications() if p.number == 1).selected) == used
    assert np.isfinite(found.state.embeddings).any()


def test_a_final_checkpoint_that_is_not_written_is_said(serve, tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(UpdateLoop.stop, "__defaults__", (0.1,))
    run = serve().fed()
    begun, goes_on, fit = threading.Event(), threading.Event(), run.server.updater.fit

    def long_update(*arguments):
        begun.set()
        goes_on.wait(30)
        return fit(*arguments)

    monkeypatch.setattr(run.server.updater, "fit", long_update)
    assert begun.wait(30)
    run.end()
    goes_on.set()
    assert not (tmp_path / "out" / "field.npz").exists()
    assert "field.npz: not written: the last update did not end" in caplog.text
