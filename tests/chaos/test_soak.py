"""Real processes, a node, an emulator and an edge, that are killed or stopped go on.

Recovery is the time from the end of a fault until the edge has taken a frame of every camera; for a kill it begins
when the new process begins its ledger. Longer runs, with memory watched, are in docs/results/soak.md.
"""

import signal
import time
from pathlib import Path

import pytest

from edge_server.report.frame_accounting import account_frames
from freshfield import ledger
from freshfield import scenario as scenarios
from freshfield.files import read_status
from freshfield_up.child_process import Child, kill, stop
from freshfield_up.ports import free_ports, is_serving
from freshfield_up.process_set import Options, process_set
from tests.deploy.test_up import SMALL
from tests.support import wait_until

ROLES = ("node", "emulator", "edge")
RECOVERY_S, LASTS_S, EVERY_S, READY_S = 2.0, 2.0, 6.0, 400.0


def streams(out: Path) -> bool:
    """Whether a frame of every camera was delivered, and the edge has made two updates."""
    edge = read_status(out / "edge.json")
    cameras = edge.get("cameras") or []
    return cameras and all(c.get("delivered") for c in cameras) and (edge.get("updates") or {}).get("count", 0) >= 2


def inject(child: Child, kind: str) -> int:
    """Inject a fault and end it. Returns the instant of its end in ns."""
    if kind == "kill":
        kill(child)
        child.start()
    else:
        child.process.send_signal(signal.SIGSTOP)
        time.sleep(LASTS_S)
        child.process.send_signal(signal.SIGCONT)
    return time.time_ns()


def recovery_s(out: Path, kind: str, role: str, over_ns: int) -> float:
    """Seconds from a fault's end, or from the new process's start, to a frame of every camera."""
    ledgers = ledger.read_all(out)
    if kind == "kill":
        over_ns = max(int(one.path.stem.rpartition("-")[2]) for one in ledgers if one.role == role)
    first: dict[str, int] = {}
    for event in (e for one in ledgers if one.role == "edge" for e in one.events if e.event == "delivered"):
        first[event.camera] = min(first.get(event.camera, 2**62), event.t_ns if event.t_ns > over_ns else 2**62)
    return (max(first.values()) - over_ns) / 1e9


@pytest.mark.slow
@pytest.mark.alone
def test_real_processes_recover_from_kills_and_a_stop(tmp_path):
    (file := tmp_path / "small.yaml").write_text(SMALL)
    found = process_set(scenarios.load(file), Options(tmp_path, port=free_ports(1)[0]))
    children = dict(zip(ROLES, (found.node, found.emulator, found.edge)))
    late = {}
    try:
        children["edge"].start()
        children["node"].start()
        wait_until(lambda: is_serving(found.edge_address), "the edge does not serve", READY_S)
        children["emulator"].start()
        wait_until(lambda: streams(tmp_path), "the cameras do not stream", READY_S)
        for kind, role in [*(("kill", role) for role in ROLES), ("stop", "emulator")]:
            over_ns = inject(children[role], kind)
            time.sleep(EVERY_S)
            assert all(child.running for child in children.values()), (kind, role)
            late[kind, role] = recovery_s(tmp_path, kind, role, over_ns)
        for child in children.values():
            stop([child])
    finally:
        for child in children.values():
            kill(child)
    assert max(late.values()) <= RECOVERY_S, late
    account = account_frames(tmp_path)
    assert account.doubts == [] and account.total["delivered"] > 300, account.as_dict()
