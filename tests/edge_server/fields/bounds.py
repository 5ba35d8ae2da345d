"""Runs code with numba's bounds checks, which need a process and compiled kernels of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest


def run_with_bounds_checks(code: str, folder: Path, request: pytest.FixtureRequest) -> None:
    """Fails unless ``code`` ends well and prints "kept". folder: for kernels where pytest keeps no cache."""
    cache = getattr(request.config, "cache", None)
    kernels = str(cache.mkdir("numba-boundscheck")) if cache is not None else str(folder)
    environment = {**os.environ, "NUMBA_BOUNDSCHECK": "1", "NUMBA_CACHE_DIR": kernels}
    out = subprocess.run(
        [sys.executable, "-c", code],
        env=environment,
        capture_output=True,
        text=True,
        cwd=Path(__file__).resolve().parents[3],
    )
    assert out.returncode == 0 and "kept" in out.stdout, out.stderr[-2000:]
