"""Memory and processor time of every process: ``processes.jsonl``, one line every two seconds.

Each line: ``{"t_s": 12.0, "edge": {"rss_mb": 512.3, "cpu": 1.42, "pid": 17}, ...}``; ``cpu`` is in cores,
over the time since the previous line. Where the system does not tell, a process is left out.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from freshfield.machine_load import cpu_s, rss_mb
from freshfield_up.processes import Child

PERIOD_S = 2.0


class ResourceMonitor:
    """Samples the processes into the file ``path``."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next_s = 0.0
        self._last: dict[int, tuple[float, float]] = {}

    def sample(self, now_s: float, children: Sequence[Child]) -> None:
        """Record the use of every running process, at most once a period. now_s: since the run began."""
        if now_s < self._next_s:
            return
        self._next_s = now_s + PERIOD_S
        line: dict[str, object] = {"t_s": round(now_s, 1)}
        for child in children:
            if child.pid is None or not child.running:
                continue
            memory_mb, used_s = rss_mb(child.pid), cpu_s(child.pid)
            if memory_mb is None or used_s is None:
                continue  # it has just ended
            then_s, before_s = self._last.get(child.pid, (now_s, used_s))
            self._last[child.pid] = now_s, used_s
            cores = round((used_s - before_s) / max(now_s - then_s, 1e-6), 2)
            line[child.name] = {"rss_mb": memory_mb, "cpu": cores, "pid": child.pid}
        with self._path.open("a") as file:
            file.write(json.dumps(line) + "\n")
