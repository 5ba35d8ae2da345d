"""Processor and memory use of this process, of another one, and of the whole machine.

Values come from /proc; what the system does not report is None, never a guess.
"""

from __future__ import annotations

import os
import resource
import statistics
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

_PROC = Path("/proc")


class LoadMeter:
    """Measures the cores that processes and the whole machine used since the last call of ``row``.

    name: key of this process in the rows.
    """

    def __init__(self, name: str = "bench") -> None:
        self._own = {name: os.getpid()}
        self._last: dict[int, tuple[float, float]] = {}
        self.row(0.0)

    def row(self, t_s: float, processes: Mapping[str, int] | None = None) -> dict[str, Any]:
        """A row of ``processes.jsonl``: ``{"t_s", NAME: {"rss_mb", "cpu", "pid"}, ..., "machine": {"cpu"}}``.

        t_s: time of the row. processes: id by name; None: this process alone. ``cpu`` is in cores, 0 in the first
        row of a process. Unreported values and ended processes are left out.
        """
        row: dict[str, Any] = {"t_s": round(t_s, 3)}
        for name, pid in (self._own if processes is None else processes).items():
            used_s = time.process_time() if pid == os.getpid() else cpu_s(pid)
            if used_s is not None:
                row[name] = {"rss_mb": rss_mb(pid), "cpu": self._cores(pid, used_s), "pid": pid}
        busy_s = _busy_s()
        if busy_s is not None:
            row["machine"] = {"cpu": self._cores(0, busy_s)}
        return row

    def _cores(self, key: int, used_s: float) -> float:
        now_s = time.perf_counter()
        then_s, before_s = self._last.get(key, (now_s, used_s))
        self._last[key] = now_s, used_s
        return round((used_s - before_s) / max(now_s - then_s, 1e-6), 2)


def outside_cores(row: Mapping[str, Any]) -> float | None:
    """Cores that other processes kept busy: the row's machine minus the row's processes; None if unknown."""
    return round(max(0.0, row["machine"]["cpu"] - _ours(row)), 2) if _has_cpu(row.get("machine")) else None


def outside_load(processes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Load of a whole run. processes: rows of ``processes.jsonl``.

    Returns {cores, ours, method}: the medians over the rows of the cores used by other processes (None if no
    row has the machine's use) and by the run's own, and how ``cores`` was measured.
    """
    ours = [_ours(row) for row in processes]
    others = [cores for row in processes if (cores := outside_cores(row)) is not None]
    return {
        "cores": round(statistics.median(others), 2) if others else None,
        "ours": round(statistics.median(ours), 2) if ours else None,
        "method": "machine minus ours" if others else None,
    }


def usable_cores() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def rss_mb(pid: int | str = "self") -> float | None:
    """Resident memory of a process in MB (10^6 bytes); None if it cannot be read."""
    words = _words(f"{pid}/statm")
    return round(int(words[1]) * resource.getpagesize() / 1e6, 1) if words else None


def cpu_s(pid: int) -> float | None:
    """Processor time that a process has used, in core-seconds; None if it cannot be read."""
    words = _words(f"{pid}/stat")
    return (int(words[11]) + int(words[12])) / os.sysconf("SC_CLK_TCK") if words else None


def _busy_s() -> float | None:
    """Core-seconds that the whole machine has been busy since it started."""
    words = _words("stat")
    # Without idle and iowait; user includes guest.
    return sum(map(int, words[1:4] + words[6:9])) / os.sysconf("SC_CLK_TCK") if words else None


def _words(name: str) -> list[str]:
    """The first line of a file below /proc, without a process's name in parentheses; empty if it cannot be read."""
    try:
        return (_PROC / name).read_text().partition("\n")[0].rpartition(")")[2].split()
    except OSError:
        return []


def _ours(row: Mapping[str, Any]) -> float:
    return sum(v["cpu"] for k, v in row.items() if k != "machine" and _has_cpu(v))


def _has_cpu(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("cpu"), int | float)
