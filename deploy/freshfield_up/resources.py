"""Memory and processor time of every process: ``processes.jsonl``, one line every two seconds.

Each line: ``{"t_s": 12.0, "edge": {"rss_mb": 512.3, "cpu": 1.42, "pid": 17}, ...}``; ``cpu`` is in cores,
over the time since the previous line.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import psutil

from freshfield_up.processes import Child

PERIOD_S = 2.0


@dataclass(frozen=True)
class ResourceUse:
    """Resident memory in MB (10^6 bytes) and processor time in cores."""

    rss_mb: float
    cpu: float
    pid: int


class ResourceMonitor:
    """Samples the processes. latest: the last sample, by process name."""

    def __init__(self, path: Path) -> None:
        self.latest: dict[str, ResourceUse] = {}
        self._path = path
        self._next_s = 0.0
        self._known: dict[int, psutil.Process] = {}

    def sample(self, now_s: float, children: Sequence[Child]) -> None:
        """Record the use of every running process, at most once a period. now_s: since the run began."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        self.latest = {}
        for child in children:
            if child.pid is None or not child.running:
                continue
            try:
                process = self._known.setdefault(child.pid, psutil.Process(child.pid))
                with process.oneshot():
                    use = ResourceUse(
                        round(process.memory_info().rss / 1e6, 1),
                        round(process.cpu_percent(None) / 100.0, 2),
                        child.pid,
                    )
            except psutil.Error:
                continue  # it has just ended
            self.latest[child.name] = use
        line = {"t_s": round(now_s, 1), **{name: vars(use) for name, use in self.latest.items()}}
        with self._path.open("a") as file:
            file.write(json.dumps(line) + "\n")
