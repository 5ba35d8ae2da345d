"""What a measurement cost and how busy others kept the machine meanwhile: rows as in ``processes.jsonl``."""

from __future__ import annotations

import os
import resource
import time
from pathlib import Path
from typing import Any

_PROC = Path("/proc")


class BenchError(RuntimeError):
    """A measurement that could not be taken; the message says what stood in its way."""


class Usage:
    """``row()`` tells of the time since the last call: cores that this process and that everybody used.

    Where the system has no /proc/stat the machine's figure is left out, never guessed.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._last = (time.perf_counter(), _own_s(), _busy_s())

    def row(self, t_s: float) -> dict[str, Any]:
        """``{"t_s": ..., NAME: {"rss_mb", "cpu", "pid"}, "machine": {"cpu"}}``, one line of a journal."""
        now = (time.perf_counter(), _own_s(), _busy_s())
        (then_s, own_then, busy_then), self._last = self._last, now
        wall = max(now[0] - then_s, 1e-6)
        row: dict[str, Any] = {
            "t_s": round(t_s, 3),
            self._name: {
                "rss_mb": rss_mb(),
                "cpu": round((now[1] - own_then) / wall, 2),
                "pid": os.getpid(),
            },
        }
        if now[2] is not None and busy_then is not None:
            row["machine"] = {"cpu": round((now[2] - busy_then) / wall, 2)}
        return row

    def outside(self, row: dict[str, Any]) -> float | None:
        """Cores that others kept busy during a row."""
        machine = row.get("machine")
        return None if machine is None else round(max(0.0, machine["cpu"] - row[self._name]["cpu"]), 2)


def rss_mb(pid: int | str = "self") -> float | None:
    """Resident memory in MB (10^6 bytes); None where /proc does not tell."""
    try:
        pages = int((_PROC / str(pid) / "statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return round(pages * resource.getpagesize() / 1e6, 1)


def peak_rss_mb() -> float:
    """The most memory this process has had resident, in MB (10^6 bytes)."""
    try:
        line = next(w for w in (_PROC / "self" / "status").read_text().splitlines() if w.startswith("VmHWM:"))
        return round(int(line.split()[1]) * 1024 / 1e6, 1)
    except (OSError, ValueError, IndexError, StopIteration):
        pass
    # Not where there is the above: on Linux a program that is started inherits this from whoever starts it.
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts kibibytes, macOS bytes.
    return round(peak * (1 if os.uname().sysname == "Darwin" else 1024) / 1e6, 1)


def cpu_s(pid: int) -> float | None:
    """Processor time that a process has used, in core-seconds; None where /proc does not tell."""
    try:
        words = (_PROC / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK")


def _own_s() -> float:
    times = os.times()
    return times.user + times.system


def _busy_s() -> float | None:
    """Core-seconds that the whole machine has been busy since it started."""
    try:
        words = (_PROC / "stat").read_text().split("\n", 1)[0].split()[1:]
        ticks = [int(word) for word in words]
    except (OSError, ValueError, IndexError):
        return None
    # user, nice, system, (idle, iowait), irq, softirq, steal; guest time is within user already.
    return float(sum(ticks[:3]) + sum(ticks[5:8])) / os.sysconf("SC_CLK_TCK")
