"""Runs real processes under faults: each must recover within two seconds, and memory must stay flat.

    python -m freshfield_up.soak --minutes 30 --json docs/results/soak.json
    python -m freshfield_up.soak --kills 34 --every 8 --json docs/results/kills.json

It starts a scenario's camera node, emulator and edge with a ``Wire`` on each of the two hops. Every minute it
injects one fault: first KILLS, then FAULTS in rotation, at last a full disk (if it may mount a tmpfs).
``--kills N`` only kills, each process N times, in turn. A killed process is restarted at once.

Recovery is the time from the end of a fault until the edge has taken a frame of every camera; for a kill it
begins when the new process begins its ledger, ``start_s`` after the kill. The exit code is 1 if a recovery
takes longer than RECOVERY_S, memory grows, or not every frame before the full disk (which loses ledger lines)
is accounted for.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from freshfield import files, ledger, machine_load
from freshfield import scenario as scenarios
from freshfield_up.commands import process_set, program
from freshfield_up.net import free_ports, is_serving
from freshfield_up.processes import Child, kill, stop
from freshfield_up.resources import ResourceMonitor
from freshfield_up.status import read_json
from freshfield_up.wire import FAULTS as WIRE_FAULTS
from freshfield_up.wire import Wire

RECOVERY_S = 2.0
GROWTH, WATCHED_MIN = 0.05, 5.0
"""Memory counts as flat if the last quarter of a process's life needs at most GROWTH more than the second
quarter. Processes that lived less than WATCHED_MIN minutes are not judged."""
ROLES = ("node", "emulator", "edge")
HOPS = ("node to emulator", "emulator to edge")
FULL_DISK = ("full disk", "the run's folder")
KILLS = tuple(("kill", role) for role in ROLES)
# Faults that leave the processes alive, so that their memory can be watched.
FAULTS = (*(("stop", role) for role in ROLES), *((kind, hop) for kind in WIRE_FAULTS for hop in HOPS))
_LASTS_S = 8.0
_DISK_BYTES = 256 << 20
_READY_S = 400.0


@dataclass
class Fault:
    """An injected fault.

    target: process or hop.
    at_s: since the run began. for_s: its duration.
    recovery_s: None if a camera did not come back before the next fault.
    start_s: of a kill, the time until the new process began its ledger.
    """

    kind: str
    target: str
    at_s: float
    for_s: float
    recovery_s: float | None = None
    start_s: float | None = None


class Soak:
    """One run in the folder ``work``. Raises RuntimeError if the deployment does not start or a process dies
    by itself."""

    def __init__(self, scenario: scenarios.Scenario, work: Path) -> None:
        self.out = work / "run"
        self.out.mkdir()
        self.scenario = scenario
        tmpfs = ["mount", "-t", "tmpfs", "-o", f"size={_DISK_BYTES}", "freshfield", str(self.out)]
        self.has_disk = subprocess.run(tmpfs, capture_output=True).returncode == 0
        found = process_set(scenario, self.out, free_ports(1)[0])
        self.children: dict[str, Child] = dict(zip(ROLES, (found.nodes[0], found.emulator, found.edge), strict=True))
        self.wires = {hop: Wire(to) for hop, to in zip(HOPS, (found.emulator_address, found.edge_address))}
        for child, wire in zip((found.nodes[0], found.emulator), self.wires.values()):
            child.command = [*child.command, "--to", wire.address]  # the last one counts
        self._edge_address = found.edge_address
        self._monitor = ResourceMonitor(work / "processes.jsonl")
        self.samples: list[tuple[float, dict[str, tuple[int, float]]]] = []
        self.loads: list[float] = []
        self.frames: dict[str, Any] = {}
        self.began_ns = time.time_ns()

    def start(self) -> None:
        """Start the processes. Returns when every camera streams and the edge has made two updates."""
        self.children["edge"].start()
        self.children["node"].start()
        self._until(lambda: is_serving(self._edge_address), "the edge does not serve")
        self.children["emulator"].start()
        self._until(self._streams, "the cameras do not stream")

    def run(self, planned: Sequence[tuple[str, str]], every_s: float) -> list[Fault]:
        """Inject one fault every ``every_s`` seconds. Returns one period after the last one.

        planned: (kind, target) of each fault.
        """
        done, next_s = [], time.monotonic() + every_s / 4
        for kind, target in planned:
            self._watch_until(next_s)
            done.append(self._do(kind, target, min(_LASTS_S, every_s / 3)))
            next_s = max(next_s + every_s, time.monotonic() + every_s / 2)
        self._watch_until(next_s)
        return done

    def end(self) -> None:
        """Stop the processes in order, and set ``frames``, the report's account of frames up to a full
        disk."""
        for child in self.children.values():
            stop([child])
        self._account()

    def _account(self) -> None:
        if self.frames:
            return
        (copy := self.out.parent / "account").mkdir()
        # Copy receivers' ledgers first: the senders' later copies then explain every frame in them.
        for role in reversed(ROLES):
            for path in self.out.glob(f"ledger-{role}-*.tsv"):
                shutil.copy(path, copy)
        subprocess.run([program("edge-server"), "report", str(copy)], capture_output=True, check=True)
        self.frames = read_json(copy / "report.json")["frames"]

    def close(self) -> None:
        for wire in self.wires.values():
            wire.close()
        for child in self.children.values():
            kill(child)
        if self.has_disk:
            subprocess.run(["umount", str(self.out)], check=True)

    def _do(self, kind: str, target: str, for_s: float) -> Fault:
        if kind == "full disk":
            self._account()
        fault = Fault(kind, target, round(self._now_s(), 3), 0.0)
        if kind == "kill":
            kill(self.children[target])
            self.children[target].start()
            return fault
        over_s = time.monotonic() + for_s
        if kind == "stop":
            process = self.children[target].process
            assert process is not None
            process.send_signal(signal.SIGSTOP)
            time.sleep(for_s)
            process.send_signal(signal.SIGCONT)
        elif kind == "full disk":
            filler = self.out / "filler"
            with filler.open("wb", buffering=0) as file:
                for size in (1 << 20, 1 << 12):
                    with contextlib.suppress(OSError):
                        while file.write(bytes(size)) == size:
                            pass
            self._watch_until(over_s)
            filler.unlink()
        else:
            self.wires[target].fault(kind)
            self._watch_until(over_s)
            self.wires[target].mend()
        fault.for_s = round(self._now_s() - fault.at_s, 3)
        return fault

    def _now_s(self) -> float:
        return (time.time_ns() - self.began_ns) / 1e9

    def _streams(self) -> bool:
        edge = read_json(self.out / "edge.json")
        cameras = edge.get("cameras") or []
        delivered = [c for c in cameras if c.get("delivered")]
        updates = (edge.get("updates") or {}).get("count", 0)
        return len(delivered) == len(self.scenario.cameras) and updates >= 2

    def _until(self, condition: Callable[[], bool], otherwise: str) -> None:
        deadline = time.monotonic() + _READY_S
        while not condition():
            self._watch_until(time.monotonic() + 0.25)
            if time.monotonic() > deadline:
                raise RuntimeError(f"{otherwise}; see {self.out}")

    def _watch_until(self, end_s: float) -> None:
        while True:
            for child in self.children.values():
                if child.process is not None and not child.running:
                    raise RuntimeError(child.exit_summary())
            self._monitor.sample(self._now_s(), list(self.children.values()))
            latest = {name: (use.pid, use.rss_mb) for name, use in self._monitor.latest.items()}
            if not self.samples or latest != self.samples[-1][1]:
                self.samples.append((self._now_s(), latest))
                self.loads.append(os.getloadavg()[0])
            left_s = end_s - time.monotonic()
            if left_s <= 0.0:
                return
            time.sleep(min(left_s, 0.25))


def judge(faults: Sequence[Fault], out: Path, cameras: Sequence[str], began_ns: int) -> None:
    """Set ``recovery_s`` and ``start_s`` of each fault from the ledgers in ``out``. began_ns: when the run
    began, UTC."""
    ledgers = ledger.read_all(out)
    arrivals: dict[str, list[float]] = {camera: [] for camera in cameras}
    for each in ledgers:
        for event in each if each.role == "edge" else ():
            if event.event == "delivered" and event.camera in arrivals:
                arrivals[event.camera].append((event.t_ns - began_ns) / 1e9)
    starts = [(each.role, (int(each.path.stem.rpartition("-")[2]) - began_ns) / 1e9) for each in ledgers]
    for fault, following in zip(faults, [*(f.at_s for f in faults[1:]), float("inf")]):
        over_s = fault.at_s + fault.for_s
        if fault.kind == "kill":
            began = [t for role, t in starts if role == fault.target and over_s <= t < following]
            if not began:
                continue
            fault.start_s, over_s = round(began[0] - over_s, 3), began[0]
        first = [min((t for t in a if t > over_s), default=following) for a in arrivals.values()]
        fault.recovery_s = round(max(first) - over_s, 3) if max(first) < following else None


def memory(samples: Sequence[tuple[float, dict[str, tuple[int, float]]]]) -> dict[str, dict[str, float]]:
    """Memory of the last process of each role: minutes watched, and medians in MB over the second and the
    last quarter of its life (the first quarter fills caches).

    samples: (seconds, (pid, MB) by role).
    """
    found = {}
    for name in ROLES:
        last = samples[-1][1].get(name, (0, 0.0))[0]
        life = [(t, use[name]) for t, use in samples if name in use and use[name][0] == last]
        quarters = [[mb for _, (_, mb) in life[k * len(life) // 4 : (k + 1) * len(life) // 4]] for k in (1, 3)]
        if all(quarters):
            early, late = map(statistics.median, quarters)
            minutes = (life[-1][0] - life[0][0]) / 60.0
            found[name] = {"minutes": round(minutes, 1), "early_mb": early, "late_mb": late}
    return found


def problems(result: dict[str, Any]) -> list[str]:
    """The conditions that did not hold, one line each."""
    found = []
    for fault in result["faults"]:
        if fault["recovery_s"] is None or fault["recovery_s"] > RECOVERY_S:
            found.append(f"{fault['kind']}, {fault['target']}, at {fault['at_s']:.0f} s: {fault['recovery_s']} s")
    for name, use in result["memory"].items():
        if use["minutes"] >= WATCHED_MIN and use["late_mb"] > (1.0 + GROWTH) * use["early_mb"]:
            found.append(f"{name} grew from {use['early_mb']} to {use['late_mb']} MB")
    frames = result["frames"]
    if not frames["closes"]:
        found.append(f"the account of frames does not close: {'; '.join(frames['doubts'])}")
    return found


def soak(scenario: str | Path, planned: Sequence[tuple[str, str]], every_s: float, work: Path) -> dict[str, Any]:
    """Run the ``planned`` faults in the folder ``work``. Returns the contents of docs/results/soak.json."""
    loaded = scenarios.load(scenario)
    run = Soak(loaded, work)
    try:
        run.start()
        faults = run.run([each for each in planned if run.has_disk or each != FULL_DISK], every_s)
        run.end()
        judge(faults, run.out, loaded.cameras, run.began_ns)
        return {
            "scenario": loaded.name,
            "every_s": every_s,
            "cores": machine_load.usable_cores(),
            "load_average": round(statistics.median(run.loads), 2),
            "faults": [asdict(fault) for fault in faults],
            "memory": memory(run.samples),
            "frames": {key: run.frames[key] for key in ("captured", "delivered", "closes", "doubts")},
        }
    finally:
        run.close()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--minutes", type=float, help="duration; kills in the first minutes only")
    what.add_argument("--kills", type=int, metavar="N", help="kill each process N times instead")
    parser.add_argument("--every", type=float, default=60.0, metavar="S", help="seconds between faults [%(default)s]")
    parser.add_argument("--scenario", default="ideal", help="scenario file, or the name of a shipped one [%(default)s]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the result to FILE")
    args = parser.parse_args()
    if args.kills:
        planned = KILLS * args.kills
    else:
        rounds = int(60.0 * args.minutes / args.every)
        planned = (*(*KILLS, *FAULTS * (rounds // len(FAULTS) + 1))[: rounds - 1], FULL_DISK)
    with tempfile.TemporaryDirectory(prefix="freshfield-soak-") as work:
        result = soak(args.scenario, planned, args.every, Path(work))
    if args.json:
        files.write_json(args.json, result, indent=1)
    print(json.dumps({key: value for key, value in result.items() if key != "faults"}))
    print("\n".join(found := problems(result)) or "every fault ended in time, and memory stayed flat")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
