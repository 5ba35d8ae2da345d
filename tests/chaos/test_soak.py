"""Faults of real processes: node, emulator and edge of a small scenario, with a TCP fault proxy on each hop.

Recovery is the time from the end of a fault until the edge has taken a frame of every camera; for a kill it begins
when the new process begins its ledger. Longer runs, with memory watched, are in docs/results/soak.md.
"""

from __future__ import annotations

import contextlib
import shutil
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from freshfield import ledger
from freshfield import scenario as scenarios
from freshfield_up.commands import process_set, program
from freshfield_up.net import free_ports, is_serving
from freshfield_up.processes import Child, kill, stop
from freshfield_up.status import read_json
from tests.chaos.tcp_fault_proxy import FAULTS, TcpFaultProxy

SMALL = """
name: small
seed: 3
cameras: {count: 4, held_out: [cam00]}
source: {kind: world, scene: room, width: 48, height: 48, fps: 15}
channel: {preset: ideal}
edge: {field: ngp, update_ms: 300, lpips: none}
"""
ROLES = ("node", "emulator", "edge")
HOPS = ("node to emulator", "emulator to edge")
FULL_DISK = ("full disk", "the run's folder")
RECOVERY_S, LASTS_S, EVERY_S, READY_S = 2.0, 2.0, 6.0, 400.0
DISK_BYTES = 256 << 20


class Soak:
    """A deployment under faults, in the folder ``work``."""

    def __init__(self, scenario: scenarios.Scenario, work: Path) -> None:
        self.out = work / "run"
        self.out.mkdir()
        tmpfs = ["mount", "-t", "tmpfs", "-o", f"size={DISK_BYTES}", "freshfield", str(self.out)]
        self.has_disk = subprocess.run(tmpfs, capture_output=True).returncode == 0
        found = process_set(scenario, self.out, free_ports(1)[0])
        self.children: dict[str, Child] = dict(zip(ROLES, (found.node, found.emulator, found.edge)))
        self.hops = {hop: TcpFaultProxy(to) for hop, to in zip(HOPS, (found.emulator_address, found.edge_address))}
        for child, hop in zip((found.node, found.emulator), self.hops.values()):
            child.command = [*child.command, "--to", hop.address]  # the last one counts
        self.edge_address = found.edge_address
        self.cameras = scenario.cameras
        self.frames: dict = {}

    def start(self) -> None:
        """Start the processes. Returns when every camera streams and the edge has made two updates."""
        self.children["edge"].start()
        self.children["node"].start()
        self._until(lambda: is_serving(self.edge_address), "the edge does not serve")
        self.children["emulator"].start()
        self._until(self._streams, "the cameras do not stream")

    def _streams(self) -> bool:
        edge = read_json(self.out / "edge.json")
        delivered = [c for c in edge.get("cameras") or [] if c.get("delivered")]
        return len(delivered) == len(self.cameras) and (edge.get("updates") or {}).get("count", 0) >= 2

    def _until(self, condition: Callable[[], bool], otherwise: str) -> None:
        deadline = time.monotonic() + READY_S
        while not condition():
            assert time.monotonic() < deadline, otherwise
            self.watch(0.25)

    def watch(self, seconds: float) -> None:
        """Wait. Fails if a process dies by itself."""
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s:
            dead = [c.exit_summary() for c in self.children.values() if c.process is not None and not c.running]
            assert not dead, dead
            time.sleep(0.1)

    def inject(self, kind: str, target: str) -> int:
        """Inject a fault and end it. Returns the instant of its end in ns."""
        if kind == "kill":
            kill(self.children[target])
            self.children[target].start()
        elif kind == "stop":
            process = self.children[target].process
            assert process is not None
            process.send_signal(signal.SIGSTOP)
            time.sleep(LASTS_S)
            process.send_signal(signal.SIGCONT)
        elif kind == FULL_DISK[0]:
            self.account()  # lines of the ledgers are lost from here on
            filler = self.out / "filler"
            with filler.open("wb", buffering=0) as file:
                for size in (1 << 20, 1 << 12):
                    with contextlib.suppress(OSError):
                        while file.write(bytes(size)) == size:
                            pass
            self.watch(LASTS_S)
            filler.unlink()
        else:
            self.hops[target].fault(kind)
            self.watch(LASTS_S)
            self.hops[target].mend()
        return time.time_ns()

    def account(self) -> None:
        """Set ``frames``, the report's account of frames so far."""
        if self.frames:
            return
        (copy := self.out.parent / "account").mkdir()
        # Copy receivers' ledgers first: the senders' later copies then explain every frame in them.
        for role in reversed(ROLES):
            for path in self.out.glob(f"ledger-{role}-*.tsv"):
                shutil.copy(path, copy)
        subprocess.run([program("edge-server"), "report", str(copy)], capture_output=True, check=True)
        self.frames = read_json(copy / "report.json")["frames"]

    def recovery_s(self, kind: str, target: str, over_ns: int) -> float:
        """Seconds from a fault's end, or from the new process's start, to a frame of every camera."""
        ledgers = ledger.read_all(self.out)
        if kind == "kill":
            starts = [int(one.path.stem.rpartition("-")[2]) for one in ledgers if one.role == target]
            over_ns = max(starts)
        arrived = [e for one in ledgers if one.role == "edge" for e in one.events if e.event == "delivered"]
        first = [
            min((e.t_ns for e in arrived if e.camera == camera and e.t_ns > over_ns), default=2**62)
            for camera in self.cameras
        ]
        return (max(first) - over_ns) / 1e9

    def close(self) -> None:
        """Free everything."""
        for hop in self.hops.values():
            hop.close()
        for child in self.children.values():
            kill(child)
        if self.has_disk:
            subprocess.run(["umount", str(self.out)], check=True)


@pytest.mark.slow
@pytest.mark.alone
def test_real_processes_recover_from_every_kind_of_fault(tmp_path: Path) -> None:
    (file := tmp_path / "small.yaml").write_text(SMALL)
    run = Soak(scenarios.load(file), tmp_path)
    planned = [*(("kill", role) for role in ROLES), ("stop", "emulator"), *((kind, HOPS[0]) for kind in FAULTS)]
    late = {}
    try:
        run.start()
        for kind, target in [*planned, *([FULL_DISK] if run.has_disk else [])]:
            over_ns = run.inject(kind, target)
            run.watch(EVERY_S)
            late[kind, target] = run.recovery_s(kind, target, over_ns)
        for child in run.children.values():
            stop([child])
        run.account()
    finally:
        run.close()
    assert run.frames["closes"] and run.frames["delivered"] > 500, run.frames
    # A length that is corrupted may leave both ends waiting: the node waits 1.25 s for an answer, and twice
    # as long after each stream that fails, up to 5 s.
    late = {fault: seconds for fault, seconds in late.items() if fault[0] != "corrupted bytes"}
    assert max(late.values()) <= RECOVERY_S, late
