"""What a run was measured on: versions, the machine, and how busy others kept it meanwhile.

A figure in milliseconds means little without these. Everything comes from /proc and installed metadata;
where the system does not tell, the value is None.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import Any

_PACKAGES = ("freshfield", "numpy", "numba", "torch", "grpcio", "opencv-contrib-python-headless")
_PROC = Path("/proc")


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that figures depend on; imports none of them."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def machine(proc: Path = _PROC) -> dict[str, Any]:
    """{cpu, cores (usable by this process), memory_gb, system, kernel}."""
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    memory_kb = _field(proc / "meminfo", "MemTotal")
    return {
        "cpu": _field(proc / "cpuinfo", "model name") or platform.processor() or None,
        "cores": usable,
        "memory_gb": round(int(memory_kb.split()[0]) * 1024 / 1e9, 1) if memory_kb else None,
        "system": platform.system(),
        "kernel": platform.release(),
    }


def outside_load(processes: Sequence[dict[str, Any]], proc: Path = _PROC) -> dict[str, Any]:
    """How many cores others kept busy.

    processes: rows of processes.jsonl. Returns {cores, ours, method}. Where rows say what the whole machine
    used (``machine: {cpu}``), ``cores`` is the median of that minus our own processes'. Else it is the
    load average of the last minute, as of now, minus what ours used then: rougher, because the load
    average counts our waiting threads too. None where neither is known.
    """
    ours, others = [], []
    for row in processes:
        own = sum(v["cpu"] for k, v in row.items() if k != "machine" and _has_cpu(v))
        ours.append(own)
        if _has_cpu(row.get("machine")):
            others.append(max(0.0, row["machine"]["cpu"] - own))
    used = round(statistics.median(ours), 2) if ours else None
    if others:
        return {"cores": round(statistics.median(others), 2), "ours": used, "method": "machine minus ours"}
    load = load_average(proc)
    if load is None or used is None:
        return {"cores": None, "ours": used, "method": None}
    last_s = processes[-1]["t_s"]
    recent = statistics.fmean(o for o, row in zip(ours, processes) if row["t_s"] > last_s - 60.0)
    return {"cores": round(max(0.0, load - recent), 2), "ours": used, "method": "load average minus ours"}


def load_average(proc: Path = _PROC) -> float | None:
    """Load average of the last minute."""
    try:
        return float((proc / "loadavg").read_text().split()[0])
    except (OSError, ValueError, IndexError):
        return None


def _has_cpu(value: Any) -> bool:
    return isinstance(value, dict) and isinstance(value.get("cpu"), int | float)


def _field(path: Path, name: str) -> str | None:
    try:
        for line in path.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == name:
                return value.strip()
    except OSError:
        pass
    return None
