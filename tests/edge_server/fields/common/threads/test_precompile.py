"""Compiling ahead: which kernels, by whom, and that a helper that fails costs nothing but time."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.fields.common.kernels.jit import kernel, part
from edge_server.fields.common.threads.precompile import _RecordingPool, _size, compile_ahead
from edge_server.fields.common.threads.thread_pool import THREADS_VARIABLE, CallerPool, Pool
from edge_server.fields.registry import field_names, make_field


@part
def _twice(x):
    return x + x


@kernel
def double(counter, worker, values):
    for i in range(values.size):
        values[i] = _twice(_twice(values[i])) / np.float32(2.0)


@kernel
def total(counter, worker, values, out):
    for i in range(values.size):
        out[0] += values[i]


@kernel
def only_after(counter, worker, out):
    out[1] = np.float64(worker) + 1.0


def run_kernels(pool: Pool) -> None:
    values, out = np.full(3, 2.0, np.float32), np.zeros(2)
    pool.run(double, values)
    pool.run(total, values, out)
    if out[0] == 12.0:
        pool.run(only_after, out)


# Who compiled what, told by numba's own count: a kernel compiled by a helper is a hit in the cache here.
TOLD = """
import sys
from edge_server.fields.common.threads import precompile
from edge_server.fields.common.threads.precompile import compile_ahead
from tests.edge_server.fields.common.threads.test_precompile import double, only_after, total, run_kernels
if sys.argv[1:]:
    sys.executable = sys.argv[1]
    precompile.PATIENCE_S = 1.0
compile_ahead(run_kernels)
for k in (double, total, only_after):
    print("loaded" if k.stats.cache_hits else "compiled", len(k.signatures))
"""


def _who(cache: Path, *executable: str, threads: int = 2) -> list[str]:
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(cache), THREADS_VARIABLE: str(threads)}
    done = subprocess.run(
        [sys.executable, "-c", TOLD, *executable], env=environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0 and not done.stderr, done.stderr
    return done.stdout.split("\n")[:-1]


def test_a_helper_compiles_beside_and_what_it_cannot_know_of_is_compiled_here(tmp_path: Path) -> None:
    # The larger one here, the other in the helper; the third is known only once the first two have run.
    assert _who(tmp_path) == ["compiled 1", "loaded 1", "compiled 1"]
    assert _who(tmp_path) == ["loaded 1"] * 3, "the second time all of it comes from the disk"


@pytest.mark.parametrize("body", ["exit 1", "exec sleep 31415", "head -n 1; echo; exit"], ids=str.split)
def test_without_its_helpers_everything_is_compiled_here(body: str, tmp_path: Path) -> None:
    helper = tmp_path / "helper"
    helper.write_text(f"#!/bin/sh\n{body}\n")
    helper.chmod(0o755)
    assert _who(tmp_path, str(helper)) == ["compiled 1"] * 3
    assert not _processes_of(helper), "it was left behind"


def _processes_of(program: Path) -> list[str]:
    found = []
    for command in Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(OSError):  # it has ended
            if str(program).encode() in (said := command.read_bytes()) or b"31415" in said:
                found.append(command.parent.name)
    return found


def test_without_a_program_to_start_everything_is_compiled_here(tmp_path: Path) -> None:
    assert _who(tmp_path, "/does/not/exist") == ["compiled 1"] * 3


def test_one_thread_asks_nobody(tmp_path: Path) -> None:
    assert _who(tmp_path, threads=1) == ["compiled 1"] * 3


def test_an_error_of_the_tour_is_the_callers() -> None:
    def fails(pool: Pool) -> None:
        raise RuntimeError("no such scene")

    with pytest.raises(RuntimeError, match="no such scene"):
        compile_ahead(fails)


def test_processes_that_store_at_once_lose_nothing(tmp_path: Path) -> None:
    """Eight, each with code of its own for one function: numba alone mixes them up."""
    (tmp_path / "one.py").write_text(
        "from edge_server.fields.common.kernels.jit import kernel\n@kernel\ndef one(x):\n    return x\n"
    )
    kinds = ["int8", "int16", "int32", "int64", "float32", "float64", "uint8", "uint16"]
    path = os.pathsep.join((str(tmp_path), *filter(None, sys.path)))
    environment = {**os.environ, "PYTHONPATH": path, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    all_of_them = [subprocess.Popen([sys.executable, "-c", COMPILE, kind], env=environment) for kind in kinds]
    assert [p.wait(60) for p in all_of_them] == [0] * len(kinds)
    stored = subprocess.run(
        [sys.executable, "-c", STORED, *kinds], env=environment, capture_output=True, text=True, timeout=60
    )
    assert stored.stdout.split() == ["True"] * len(kinds), stored.stderr


COMPILE = """
import sys
from numba import types
from one import one
one.compile((getattr(types, sys.argv[1]),))
"""
STORED = """
import sys
from numba import types
from edge_server.fields.common.kernels.jit import is_stored
from one import one
for kind in sys.argv[1:]:
    of = getattr(types, kind)
    print(is_stored(one, (of,)) and one.compile((of,)) and one.stats.cache_hits[(of,)] == 1)
"""


RENAMED = """
from typing import NamedTuple
from edge_server.fields.common.kernels.jit import kernel
class {name}(NamedTuple):
    x: float
@kernel
def one(pair):
    return pair.x
print(one({name}(2.0)))
"""


def test_code_for_a_type_that_was_renamed_is_compiled_anew(tmp_path: Path) -> None:
    """numba reads the types of what it has stored before it asks whether the sources are still the same."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    environment["PYTHONPATH"] = os.pathsep.join((str(tmp_path), *filter(None, sys.path)))
    for name in ("Old", "New"):
        (tmp_path / "one.py").write_text(RENAMED.format(name=name))
        done = subprocess.run(
            [sys.executable, "-c", "import one"], env=environment, capture_output=True, text=True, timeout=60
        )
        assert done.stdout == "2.0\n", done.stderr
    assert list((tmp_path / "cache").rglob("*.nbi")), "nothing was stored: nothing was tested"


def test_what_is_inlined_counts() -> None:
    def own(kernel: Any) -> int:  # of what passes the arguments on, and of what it passes them to
        return len(kernel.py_func.__code__.co_code) + _size(kernel.py_func.__globals__["inside"].py_func)

    assert _size(double.py_func) == own(double) > _size(_twice.py_func)
    inside = double.py_func.__globals__["inside"].py_func
    assert _size(inside) == len(inside.__code__.co_code) + _size(_twice.py_func)
    assert _size(total.py_func) == own(total)


class _Noting(CallerPool):
    def __init__(self) -> None:
        super().__init__()
        self.kernels: set[Any] = set()

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        self.kernels.add(kernel)
        super().run(kernel, *args)


@pytest.mark.parametrize("name", field_names())
def test_every_field_lists_its_large_kernels_without_running_them(name: str) -> None:
    field, listing, run = make_field(name), _RecordingPool(), _Noting()
    with np.errstate(all="ignore"):
        field._run_kernels(listing)
    field._run_kernels(run)
    listed = {kernel for kernel, _ in listing.calls}
    assert listed <= run.kernels, "compiled for nothing"
    wanted = {k for k in run.kernels if k.py_func.__name__.startswith(("train_", "render_"))}
    assert wanted and wanted <= listed
    assert 2 * len(listed) > len(run.kernels), "most of it must be known before anything is run"
