"""Faults of real processes: node, emulator and edge of a small scenario, with a TCP fault proxy behind the node.

Recovery is the time from the end of a fault until the edge has taken a frame of every camera; for a kill it begins
when the new process begins its ledger. Longer runs, with memory watched, are in docs/results/soak.md.
"""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import pytest

from freshfield import ledger
from freshfield import scenario as scenarios
from freshfield_up.commands import process_set, program
from freshfield_up.net import free_ports, is_serving
from freshfield_up.processes import Child, kill, stop
from freshfield_up.status import read_json
from tests.chaos.tcp_fault_proxy import FAULTS, TcpFaultProxy
from tests.support import wait_until

SMALL = """
name: small
seed: 3
cameras: {count: 4, held_out: [cam00]}
source: {kind: world, scene: room, width: 48, height: 48, fps: 15}
channel: {preset: ideal}
edge: {field: ngp, update_ms: 300, lpips: none}
"""
ROLES = ("node", "emulator", "edge")
RECOVERY_S, LASTS_S, EVERY_S, READY_S = 2.0, 2.0, 6.0, 400.0


class Soak:
    """A deployment under faults, in the folder ``out``."""

    def __init__(self, scenario: scenarios.Scenario, out: Path) -> None:
        self.out = out
        found = process_set(scenario, out, free_ports(1)[0])
        self.children: dict[str, Child] = dict(zip(ROLES, (found.node, found.emulator, found.edge)))
        self.hop = TcpFaultProxy(found.emulator_address)
        found.node.command = [*found.node.command, "--to", self.hop.address]  # the last one counts
        self.edge_address, self.cameras = found.edge_address, scenario.cameras

    def start(self) -> None:
        """Start the processes. Returns when every camera streams and the edge has made two updates."""
        self.children["edge"].start()
        self.children["node"].start()
        wait_until(lambda: is_serving(self.edge_address), "the edge does not serve", READY_S)
        self.children["emulator"].start()
        wait_until(self._streams, "the cameras do not stream", READY_S)

    def _streams(self) -> bool:
        edge = read_json(self.out / "edge.json")
        delivered = [c for c in edge.get("cameras") or [] if c.get("delivered")]
        return len(delivered) == len(self.cameras) and (edge.get("updates") or {}).get("count", 0) >= 2

    def inject(self, kind: str, target: str) -> int:
        """Inject a fault and end it. Returns the instant of its end in ns."""
        child = self.children.get(target)
        if kind == "kill":
            kill(child)
            child.start()
        elif kind == "stop":
            child.process.send_signal(signal.SIGSTOP)
            time.sleep(LASTS_S)
            child.process.send_signal(signal.SIGCONT)
        else:
            self.hop.fault(kind)
            time.sleep(LASTS_S)
            self.hop.mend()
        return time.time_ns()

    def recovery_s(self, kind: str, target: str, over_ns: int) -> float:
        """Seconds from a fault's end, or from the new process's start, to a frame of every camera."""
        ledgers = ledger.read_all(self.out)
        if kind == "kill":
            over_ns = max(int(one.path.stem.rpartition("-")[2]) for one in ledgers if one.role == target)
        first = dict.fromkeys(self.cameras, 2**62)
        for event in (event for one in ledgers if one.role == "edge" for event in one.events):
            if event.event == "delivered" and event.t_ns > over_ns:
                first[event.camera] = min(first[event.camera], event.t_ns)
        return (max(first.values()) - over_ns) / 1e9


@pytest.mark.slow
@pytest.mark.alone
def test_real_processes_recover_from_every_kind_of_fault(tmp_path: Path) -> None:
    (file := tmp_path / "small.yaml").write_text(SMALL)
    run = Soak(scenarios.load(file), tmp_path)
    late = {}
    try:
        run.start()
        for kind, target in [
            *(("kill", role) for role in ROLES),
            ("stop", "emulator"),
            *((kind, "") for kind in FAULTS),
        ]:
            over_ns = run.inject(kind, target)
            time.sleep(EVERY_S)
            assert all(child.running for child in run.children.values()), (kind, target)
            late[kind, target] = run.recovery_s(kind, target, over_ns)
        for child in run.children.values():
            stop([child])
    finally:
        run.hop.close()
        for child in run.children.values():
            kill(child)
    subprocess.run([program("edge-server"), "report", str(tmp_path)], capture_output=True, check=True)
    frames = read_json(tmp_path / "report.json")["frames"]
    assert frames["closes"] and frames["delivered"] > 500, frames
    # A length that is corrupted may leave both ends waiting: the node waits 1.25 s for an answer, and twice
    # as long after each stream that fails, up to 5 s.
    late = {fault: seconds for fault, seconds in late.items() if fault[0] != "corrupted bytes"}
    assert max(late.values()) <= RECOVERY_S, late
