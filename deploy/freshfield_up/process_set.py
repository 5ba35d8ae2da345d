"""The commands of a scenario's processes, connected by free loopback ports: node -> emulator -> edge.

The nodes know only the emulator's address.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from freshfield.machine_load import usable_cores
from freshfield.scenario import Scenario
from freshfield_up.child_process import Child
from freshfield_up.ports import LOOPBACK, free_ports

# Variables that set the threads of numeric libraries, which start one for each core by default. Nodes and emulator get
# only one: they gain nothing from more, which would compete with the edge's. The edge may use every core.
_EDGE_THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_THREADS = (*_EDGE_THREADS, "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS", "OPENCV_FOR_THREADS_NUM")
_ARM_PORT = 30004  # RTDE, the fixed port for the state of every controller


class MissingCommand(RuntimeError):
    """Something is not installed; the message says how to install it."""


@dataclass(frozen=True)
class Options:
    """How a run is made.

    out: folder of the run.
    duration_s: seconds after everything is up; 0: no end.
    port: loopback port of the page.
    data: folder of recorded data, if any.
    seed, policy: in place of the scenario's.
    """

    out: Path
    duration_s: float = 60.0
    port: int = 8080
    data: Path | None = None
    seed: int | None = None
    policy: str | None = None


@dataclass(frozen=True)
class ProcessSet:
    """The processes of one scenario.

    edge_address, emulator_address: HOST:PORT on which they listen.
    arms: one process if the scenario has a simulated arm, else none. arm_address: HOST:PORT of the arm.
    drivers: one process if that arm has a path, else none.
    """

    edge: Child
    emulator: Child
    node: Child
    edge_address: str
    emulator_address: str
    arms: list[Child] = field(default_factory=list)
    arm_address: str = ""
    drivers: list[Child] = field(default_factory=list)

    @property
    def children(self) -> list[Child]:
        """All processes in the order in which they stop: senders before receivers."""
        return [child for group in self.groups for child in group]

    @property
    def groups(self) -> list[list[Child]]:
        """``children`` in groups that may stop together."""
        return [self.drivers, [self.node], self.arms, [self.emulator], [self.edge]]


def process_set(scenario: Scenario, options: Options) -> ProcessSet:
    """The processes of a run, not started yet, with their commands, addresses and log files. Raises MissingCommand."""
    edge_address, emulator_address = (f"{LOOPBACK}:{port}" for port in free_ports(2))
    common = [f"--out={options.out}", *([] if options.seed is None else [f"--seed={options.seed}"])]
    recorded = [] if options.data is None else [f"--data={options.data}"]
    policy = [] if options.policy is None else [f"--policy={options.policy}"]
    limits = _unless_set(_THREADS, 1)

    def child(name: str, role: str, command: str, action: str, *arguments: str) -> Child:
        words = [program(command), action, str(scenario.path), *arguments]
        return Child(name, role, words, options.out / f"log-{name}.txt", limits)

    listens = [f"--listen={edge_address}", f"--page-host={LOOPBACK}", f"--page-port={options.port}"]
    listens.append(f"--emulator={emulator_address}")
    edge = child("edge", "the edge server", "edge-server", "run", *listens, *common, *recorded, *policy)
    edge.environment = _unless_set(_EDGE_THREADS, usable_cores())
    between = f"--listen={emulator_address}", f"--to={edge_address}"
    emulator = child("emulator", "the channel emulator", "channel-emu", "run", *between, *common)
    node = child(
        "node", "the camera node", "camera-node", "run", "--all", f"--to={emulator_address}", *common, *recorded
    )
    arm = scenario.source.get("arm")
    if not isinstance(arm, dict) or not arm.get("simulated"):
        return ProcessSet(edge, emulator, node, edge_address, emulator_address)
    arms = [child("arm", "the simulated arm", "camera-node", "simulate-arm")]
    drivers = [child("driver", "the arm's driver", "camera-node", "drive-arm")] if arm.get("path") else []
    arm_address = f"{arm.get('host')}:{_ARM_PORT}"
    return ProcessSet(edge, emulator, node, edge_address, emulator_address, arms, arm_address, drivers)


def _unless_set(variables: Sequence[str], threads: int) -> dict[str, str]:
    """Values for the variables that the user has not set."""
    return {name: str(threads) for name in variables if name not in os.environ}


def program(name: str) -> str:
    """Path of one of the project's commands, preferably in this interpreter's environment. Raises
    MissingCommand."""
    beside = Path(sys.executable).parent / name
    found = str(beside) if beside.exists() else shutil.which(name)
    if found is None:
        raise MissingCommand(
            f"{name} is not installed beside {sys.executable}; use `make demo`, or install the project "
            "there with: pip install -e '.[edge]'"
        )
    return found
