"""What a run was measured on: versions and the machine. ``freshfield.machine_load`` has how busy it was.

A figure in milliseconds means little without these. Everything comes from /proc and installed metadata;
where the system does not tell, the value is None.
"""

from __future__ import annotations

import importlib.metadata
import platform
import shlex
import subprocess
import sys
from datetime import datetime
from pathlib import Path
from typing import Any

from freshfield.machine_load import usable_cores

_PACKAGES = ("freshfield", "numpy", "numba", "torch", "grpcio", "opencv-contrib-python-headless")
_PROC = Path("/proc")


def run_facts() -> dict[str, Any]:
    """Date, command line, commit, host, machine and versions of this process: see ``run_records.RunFacts``."""
    return {
        "started": datetime.now().astimezone().isoformat(timespec="seconds"),
        "command": shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "commit": commit(),
        "host": platform.node(),
        "machine": machine(),
        "versions": versions(),
    }


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that figures depend on; imports none of them."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


def commit() -> str | None:
    """The commit that the program runs from, with ``-dirty`` where files differ from it; None outside a
    clone."""
    root = Path(__file__).parents[1]
    if not (root / ".git").exists():
        return None
    command = ["git", "-C", str(root), "describe", "--always", "--dirty", "--abbrev=10", "--exclude=*"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def machine(proc: Path = _PROC) -> dict[str, Any]:
    """{cpu, cores (usable by this process), memory_gb, system, kernel, gpus (NVIDIA's, by name)}."""
    memory_kb = _field(proc / "meminfo", "MemTotal")
    return {
        "cpu": _field(proc / "cpuinfo", "model name") or platform.processor() or None,
        "cores": usable_cores(),
        "memory_gb": round(int(memory_kb.split()[0]) * 1024 / 1e9, 1) if memory_kb else None,
        "system": platform.system(),
        "kernel": platform.release(),
        "gpus": [
            name for path in sorted(proc.glob("driver/nvidia/gpus/*/information")) if (name := _field(path, "Model"))
        ],
    }


def _field(path: Path, name: str) -> str | None:
    try:
        for line in path.read_text().splitlines():
            key, _, value = line.partition(":")
            if key.strip() == name:
                return value.strip()
    except OSError:
        pass
    return None
