"""Writes the lock files that the images install from: ``python deploy/lock.py`` (``make lock``).

``deploy/locks/*.txt`` name each package's exact version and the SHA-256 of its wheels, for Python 3.11 on
Linux (x86-64, and ARM if there is a wheel). ``camera`` is for nodes and emulator, ``edge`` for the edge
without torch, ``torch-cpu`` and ``torch-cuda`` for each build of torch with the packages that only it needs,
``build`` for building the package. Versions are the newest that pyproject.toml allows, except torch's, which
is set here.

Needs Python 3.11 and pip 23 or newer. The CPU build of torch is not on the default index: name PyTorch's
index in TORCH_INDEX, or in pip's configuration.
"""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

TORCH = "2.13.0"
"""The version with which checkpoints, kernels and figures were made."""

ROOT = Path(__file__).resolve().parent.parent
LOCKS = ROOT / "deploy" / "locks"
ARM = ("manylinux_2_28_aarch64", "manylinux_2_17_aarch64", "manylinux2014_aarch64")

Lock = dict[str, tuple[str, set[str]]]
"""Version and hashes by package."""


def resolve(*wanted: str, pins: Lock | None = None) -> Lock:
    """The packages that pip would install for the requirements ``wanted`` on this machine.

    pins: versions to use for the packages in it. Exits the program if pip cannot resolve them.
    """
    index = os.environ.get("TORCH_INDEX")
    with tempfile.NamedTemporaryFile("w", suffix=".txt") as constraints:
        constraints.writelines(f"{name}=={version}\n" for name, (version, _) in (pins or {}).items())
        constraints.flush()
        words = ["-c", constraints.name, *(["--extra-index-url", index] if index else []), *wanted]
        done = _dry_run(*words)
    if done.returncode:
        sys.exit(f"lock: pip resolved nothing for {' '.join(wanted)}: {done.stderr.strip()}")
    return _wheels(done.stdout)


def arm_hashes(requirement: str) -> set[str]:
    """Hashes of a requirement's wheel for ARM; empty if there is none."""
    platforms = (f"--platform={name}" for name in ARM)
    done = _dry_run("--no-deps", "--target", tempfile.gettempdir(), *platforms, requirement)
    return set() if done.returncode else {h for _, hashes in _wheels(done.stdout).values() for h in hashes}


def _dry_run(*words: str) -> subprocess.CompletedProcess[str]:
    what = ("install", "-q", "--dry-run", "--ignore-installed", "--only-binary=:all:", "--report", "-")
    return subprocess.run([sys.executable, "-m", "pip", *what, *words], cwd=ROOT, capture_output=True, text=True)


def _wheels(report: str) -> Lock:
    """The packages in pip's report, without the project itself, which is not an archive."""
    return {
        item["metadata"]["name"].lower().replace("_", "-"): (
            item["metadata"]["version"],
            {sha256(item["download_info"])},
        )
        for item in json.loads(report)["install"]
        if "archive_info" in item["download_info"]
    }


def sha256(download: dict[str, Any]) -> str:
    """Hash of one wheel in pip's report; computed if the wheel is a local file without a hash."""
    known = download["archive_info"].get("hashes", {}).get("sha256")
    if known is None:
        known = hashlib.sha256(Path(unquote(urlsplit(download["url"]).path)).read_bytes()).hexdigest()
    return known


def write(name: str, lock: Lock) -> None:
    """Write ``locks/NAME.txt``, one line a package. Adds the hashes of the wheels for ARM to ``lock``."""
    pinned = {package: f"{package}=={version}" for package, (version, _) in lock.items()}
    for package, requirement in pinned.items():
        lock[package][1].update(arm_hashes(requirement))
    lines = [
        " ".join([pinned[package], *(f"--hash=sha256:{h}" for h in sorted(lock[package][1]))])
        for package in sorted(lock)
    ]
    (LOCKS / f"{name}.txt").write_text("# Written by deploy/lock.py.\n" + "\n".join(lines) + "\n")


def main() -> None:
    LOCKS.mkdir(exist_ok=True)
    # "===" compares text; "==" would accept builds with another local version (+cpu) as well.
    cuda = resolve(".[edge,embed]", f"torch==={TORCH}")
    cpu = resolve(".[edge,embed]", f"torch==={TORCH}+cpu", pins={n: v for n, v in cuda.items() if n != "torch"})
    edge = {name: cpu[name] for name in cpu.keys() & cuda.keys() - {"torch"}}
    for name, lock in {
        "build": resolve(*tomllib.loads((ROOT / "pyproject.toml").read_text())["build-system"]["requires"]),
        "camera": resolve(".", pins=edge),
        "edge": edge,
        "torch-cpu": {name: cpu[name] for name in cpu.keys() - edge.keys()},
        "torch-cuda": {name: cuda[name] for name in cuda.keys() - edge.keys()},
    }.items():
        write(name, lock)
        print(f"deploy/locks/{name}.txt: {len(lock)} packages")


if __name__ == "__main__":
    main()
