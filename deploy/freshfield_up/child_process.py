"""Child processes: starts them detached from the terminal, logs their output, describes their exit, stops
them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from freshfield_up.launcher_constants import GRACE_S, LAST_LINES, STOPPED_POLL_S

# Asks Linux to end the process when its parent is gone (prctl's PR_SET_PDEATHSIG), and becomes the command. Not between
# fork and exec: there a process with gRPC's threads may not run Python.
_DIE_WITH_PARENT = """
import ctypes, os, signal, sys
ctypes.CDLL(None).prctl(1, signal.SIGTERM, 0, 0, 0)
signal.signal(signal.SIGPIPE, signal.SIG_DFL)
if os.getppid() == int(sys.argv[1]):
    os.execvp(sys.argv[2], sys.argv[2:])
"""


@dataclass
class Child:
    """One process of the run.

    role: its name in messages, such as ``the edge server``.
    log: file to which its output is appended.
    environment: variables in addition to this process's.
    started_s: monotonic time of its last start.
    killed: whether it did not end in time and had to be killed.
    """

    name: str
    role: str
    command: Sequence[str]
    log: Path
    environment: Mapping[str, str] = field(default_factory=dict)
    process: subprocess.Popen[bytes] | None = None
    started_s: float = 0.0
    killed: bool = False

    def start(self) -> None:
        """Start it in its own session: Ctrl-C reaches only the launcher, which stops processes in order."""
        with self.log.open("ab") as log:
            log.write(f"$ {' '.join(self.command)}\n".encode())
            log.flush()
            starter: tuple[str, ...] = ()
            if sys.platform == "linux":
                starter = (sys.executable, "-I", "-S", "-c", _DIE_WITH_PARENT, str(os.getpid()))
            self.process = subprocess.Popen(
                [*starter, *self.command],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                env={**os.environ, "PYTHONUNBUFFERED": "1", **self.environment},
                start_new_session=True,
            )
        self.started_s = time.monotonic()

    @property
    def running(self) -> bool:
        return self.process is not None and self.process.poll() is None

    @property
    def pid(self) -> int | None:
        return self.process.pid if self.process is not None else None

    def exit_summary(self) -> str:
        """How the process ended, and the last lines of its log. It must have ended."""
        assert self.process is not None and self.process.returncode is not None
        age_s = time.monotonic() - self.started_s
        said = f"{self.role} {describe_exit(self.process.returncode)}, {age_s:.1f} s after its start."
        last = [f"  | {line}" for line in tail(self.log, LAST_LINES)]
        return "\n".join(
            [said, f"The last lines of {self.log}:" if last else f"It wrote nothing to {self.log}.", *last]
        )


def stop(children: Sequence[Child], grace_s: float = GRACE_S, hurry: Callable[[], bool] = bool) -> None:
    """Send SIGTERM to all at once, and SIGKILL to those still running after ``grace_s`` seconds, or once ``hurry``
    says so; without one it never does."""
    for child in children:
        if child.running:
            child.process.send_signal(signal.SIGTERM)  # type: ignore[union-attr]
    deadline = time.monotonic() + grace_s
    while any(child.running for child in children) and time.monotonic() < deadline and not hurry():
        time.sleep(STOPPED_POLL_S)
    for child in children:
        if child.running:
            child.killed = True
            kill(child)


def kill(child: Child) -> None:
    """Kill the process and everything that it started (its process group)."""
    if child.process is None or child.process.poll() is not None:
        return
    try:
        os.killpg(child.process.pid, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        child.process.kill()
    child.process.wait()


def describe_exit(returncode: int) -> str:
    """The meaning of a ``subprocess`` return code, in words."""
    if returncode >= 0:
        return f"ended by itself with exit code {returncode}"
    try:
        name = signal.Signals(-returncode).name
    except ValueError:
        name = f"signal {-returncode}"
    why = {
        "SIGKILL": " (by a person, or by the system because memory ran out)",
        "SIGSEGV": " (a crash in native code)",
        "SIGABRT": " (a native library gave up)",
        "SIGILL": " (an instruction this processor does not have)",
        "SIGBUS": " (memory or disk behind a mapped file is gone)",
    }.get(name, "")
    return f"was killed by {name}{why}"


def tail(path: Path, lines: int) -> list[str]:
    """The last non-empty lines of a log that may be missing, or end in half a character."""
    try:
        with path.open(errors="replace") as file:
            written = (line.rstrip() for line in file if line.strip() and not line.startswith("$ "))
            return list(deque(written, lines))
    except OSError:
        return []
