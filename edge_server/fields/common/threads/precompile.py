"""Compiling before the first fit, on every core: numba compiles one function at a time in a process, so other
processes compile the rest into the cache on disk."""

from __future__ import annotations

import base64
import logging
import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from typing import Any

import numpy as np
from numba import typeof
from numba.core.dispatcher import Dispatcher

from edge_server.fields.common.kernels.jit import is_stored
from edge_server.fields.common.threads import work_queue
from edge_server.fields.common.threads.thread_pool import CallerPool, Pool, cores

HELPERS = 3  # at most: the largest kernel takes as long as a quarter of all
PATIENCE_S = 60.0  # with a helper, after everything else is compiled; then its kernel is compiled here
_HELPER = "from edge_server.fields.common.threads.precompile import _serve; _serve()"

log = logging.getLogger(__name__)

Call = tuple[Dispatcher, tuple[Any, ...]]  # a kernel and the numba types of its arguments


def compile_ahead(run_kernels: Callable[[Pool], None]) -> float:
    """Compile, or load from numba's cache, all kernels that ``run_kernels`` runs; returns the seconds.

    run_kernels: called twice with a pool to run kernels in. The first pool only records them, the second runs
    them. Kernels that are missed at first, because they depend on what others compute, are compiled then.
    """
    start = time.perf_counter()
    recording = _RecordingPool()
    with np.errstate(all="ignore"):  # of memory that no kernel filled
        run_kernels(recording)
    missing = sorted((c for c in recording.calls if not is_stored(*c)), key=lambda call: -_size(call[0].py_func))
    if len(missing) > 1:
        own = [(kernel, tuple(map(typeof, args))) for kernel, args in work_queue.kernel_calls()]  # a pool's
        missing += [call for call in own if not is_stored(*call)]
        _compile_together(missing, min(cores() - 1, HELPERS, len(missing) - 1))
    run_kernels(CallerPool())
    return time.perf_counter() - start


class _RecordingPool(CallerPool):
    """Runs nothing and records what would be called, each once, in order."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[Call, None] = {}

    def run(self, kernel: Callable[..., Any], *args: Any) -> None:
        assert isinstance(kernel, Dispatcher)
        types = tuple(typeof(value) for value in (np.zeros(1, np.int64), 0, *args))
        self.calls[kernel, types] = None


def _compile_together(calls: list[Call], helpers: int) -> None:
    """Compile the kernels, the largest first, here and in ``helpers`` other processes. What fails there is
    compiled here when it is needed."""
    waiting = deque(calls)
    # The largest one here: a helper takes time to start.
    mine = waiting.popleft()
    running = [_CompilerProcess(waiting) for _ in range(helpers)]
    try:
        mine[0].compile(mine[1])
        for kernel, types in _drawn(waiting):
            kernel.compile(types)
        for helper in running:
            helper.join(PATIENCE_S)
    finally:
        waiting.clear()
        for helper in running:
            helper.end()


def _drawn(waiting: deque[Call]) -> Iterator[Call]:
    while waiting:
        try:
            yield waiting.popleft()
        except IndexError:  # another thread was faster
            return


class _CompilerProcess(threading.Thread):
    """A thread whose own process compiles kernels until none are left."""

    def __init__(self, waiting: deque[Call]) -> None:
        super().__init__(name="compiles-ahead", daemon=True)
        self._waiting = waiting
        self._process: subprocess.Popen[bytes] | None = None
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-c", _HELPER],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            )
        except OSError as error:
            log.info("no process to compile kernels beside this one: %s", error)
        else:
            self.start()

    def run(self) -> None:
        assert self._process and self._process.stdin and self._process.stdout
        try:
            for kernel, types in _drawn(self._waiting):
                order = (kernel.py_func.__module__, kernel.py_func.__qualname__, types)
                self._process.stdin.write(base64.b64encode(pickle.dumps(order)) + b"\n")
                self._process.stdin.flush()
                if not self._process.stdout.readline():
                    log.info("a process that compiled kernels ended early: %s is compiled here", order[1])
                    return
        except (OSError, ValueError):  # it has ended, or ``end`` has closed its pipes
            return

    def join(self, timeout: float | None = None) -> None:
        """Wait for the kernel being compiled, if the process could be started."""
        if self._process is not None:
            super().join(timeout)

    def end(self) -> None:
        """Kill the process."""
        if self._process is None:
            return
        self._process.kill()
        self._process.wait()
        super().join(1.0)
        for pipe in () if self.is_alive() else (self._process.stdin, self._process.stdout):
            if pipe is not None:
                with suppress(OSError):  # what was still buffered has nowhere to go
                    pipe.close()


def _serve() -> None:
    """The helper process: compile what each line of stdin asks for and answer with a line, until it ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C ends who asked, and with it stdin
    for line in sys.stdin.buffer:
        module, name, types = pickle.loads(base64.b64decode(line))
        getattr(import_module(module), name).compile(types)
        sys.stdout.buffer.write(b"\n")
        sys.stdout.buffer.flush()


def _size(function: Callable[..., Any], inside: frozenset[Any] = frozenset()) -> int:
    """How much there is to compile: bytes of code of a function and of the parts that it calls."""
    inside |= {function}  # names may be attributes', and lead back here
    named = (function.__globals__.get(name) for name in function.__code__.co_names)
    parts = {value.py_func for value in named if isinstance(value, Dispatcher)} - inside
    return len(function.__code__.co_code) + sum(_size(part, inside) for part in parts)
