"""Faults of real processes: a short soak, and what the long one is judged by."""

from __future__ import annotations

import socket
import socketserver
import threading
import time
from pathlib import Path

import pytest

from freshfield.ledger import Ledger
from freshfield_up import soak
from freshfield_up.wire import Wire
from tests.waiting import wait_until

SMALL = """
name: small
seed: 3
cameras: {count: 4, held_out: [cam00]}
source: {kind: world, scene: room, width: 48, height: 48, fps: 15}
channel: {preset: ideal}
edge: {field: ngp, update_ms: 300, lpips: none}
"""


@pytest.mark.slow
@pytest.mark.alone
def test_real_processes_recover_from_every_kind_of_fault(tmp_path: Path) -> None:
    (file := tmp_path / "small.yaml").write_text(SMALL)
    planned = (*soak.KILLS, ("stop", "emulator"), *soak.FAULTS[-6::2], soak.FULL_DISK)
    result = soak.soak(file, planned, 6.0, tmp_path)
    kinds = {fault["kind"] for fault in result["faults"]}
    assert kinds | {"full disk"} == {kind for kind, _ in (*soak.KILLS, *soak.FAULTS, soak.FULL_DISK)}
    assert result["frames"]["closes"] and result["frames"]["delivered"] > 500, result["frames"]
    # A length that is corrupted may leave both ends waiting: the node waits 1.25 s for an answer, and twice
    # as long after each stream that fails, up to 5 s.
    assert not [line for line in soak.problems(result) if not line.startswith("corrupted bytes")]


class Echo(socketserver.BaseRequestHandler):
    def handle(self) -> None:
        while data := self.request.recv(1 << 16):
            self.request.sendall(data)


@pytest.fixture
def wire():
    with socketserver.ThreadingTCPServer(("127.0.0.1", 0), Echo) as server:
        server.daemon_threads = True
        threading.Thread(target=server.serve_forever, daemon=True).start()
        wire = Wire(f"127.0.0.1:{server.server_address[1]}")
        yield wire
        wire.close()
        server.shutdown()


def connect(wire: Wire) -> socket.socket:
    host, port = wire.address.split(":")
    return socket.create_connection((host, int(port)), timeout=0.3)


def test_a_wire_has_the_faults_of_a_network_and_mends(wire: Wire) -> None:
    near = connect(wire)

    def echo(data: bytes) -> bytes:
        near.sendall(data)
        try:
            return near.recv(100)
        except TimeoutError:
            return b"nothing"

    assert echo(b"whole") == b"whole"
    wire.fault("corrupted bytes")
    assert wait_until(lambda: (got := echo(b"whole")) != b"whole" and got, "never corrupted") != b"nothing"
    wire.mend()
    wait_until(lambda: echo(b"whole") == b"whole", "corrupted for ever")
    wire.fault("black hole")
    time.sleep(0.1)
    assert echo(b"late") == b"nothing"
    wire.mend()
    assert near.recv(100) == b"late"  # as TCP has it: late, and not lost
    wire.fault("half-open")
    time.sleep(0.1)
    assert echo(b"gone") == b"nothing"
    with connect(wire) as other:
        other.sendall(b"new")
        assert other.recv(100) == b"new"
    wire.mend()
    assert near.recv(100) == b"", "its end has not been told"
    near.close()


def test_recovery_ends_with_the_last_camera_and_a_kill_is_split_at_the_new_process(tmp_path: Path) -> None:
    second = 10**9

    def edge(start_s: float, *arrivals: tuple[str, float]) -> None:
        book = Ledger(tmp_path, "edge", "edge", int(start_s * second))
        for sequence, (camera, at_s) in enumerate(arrivals):
            book.write(int(at_s * second), camera, "s", sequence, "delivered")
        book.close(int(at_s * second))

    edge(0.0, ("a", 1.0), ("b", 1.1), ("a", 15.5), ("b", 16.25), ("a", 17.0), ("a", 19.0))
    edge(21.5, ("b", 21.75), ("a", 22.0))
    faults = [
        soak.Fault("stop", "edge", 10.0, 5.0),
        soak.Fault("stop", "edge", 18.0, 0.5),
        soak.Fault("kill", "edge", 20.0, 0.0),
    ]
    soak.judge(faults, tmp_path, ["a", "b"], 0)
    assert [(f.recovery_s, f.start_s) for f in faults] == [(1.25, None), (None, None), (0.5, 1.5)]


def test_a_run_is_judged_by_recoveries_memory_and_account() -> None:
    def samples(growth_mb: float) -> list:
        old = [(float(t), {"edge": (1, 900.0)}) for t in range(0, 60, 2)]
        return old + [
            (60.0 + t, {"edge": (2, 400.0 + growth_mb * t / 600.0), "node": (3, 80.0)}) for t in range(0, 602, 2)
        ]

    fault = {"kind": "stop", "target": "edge", "at_s": 1.0, "recovery_s": 1.9}
    good = {"faults": [fault], "memory": soak.memory(samples(0.0)), "frames": {"closes": True, "doubts": []}}
    assert not soak.problems(good)
    assert good["memory"]["edge"] == {"minutes": 10.0, "early_mb": 400.0, "late_mb": 400.0}
    for worse in (
        {"faults": [{**fault, "recovery_s": 2.1}]},
        {"faults": [{**fault, "recovery_s": None}]},
        {"memory": soak.memory(samples(60.0))},
        {"frames": {"closes": False, "doubts": ["lost"]}},
    ):
        assert len(soak.problems({**good, **worse})) == 1
