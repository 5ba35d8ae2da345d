"""Free ports, small worlds, waits for other threads and processes, and the work that a refusal takes."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Callable
from types import FrameType
from typing import Any

MOST_MS = 50.0
"""Of the work before a refusal: ingest answers every camera on one thread."""


def free_port() -> int:
    """A TCP port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def small_world(**changed: Any) -> dict[str, Any]:
    """The source of a scenario: a room in small pictures."""
    size = {"kind": "world", "scene": "room", "width": 32, "height": 32, "fps": 15}
    return {**size, "params": {"supersample": 1}, **changed}


def wait_until(condition: Callable[[], Any], what: str | Callable[[], str], timeout_s: float = 20.0) -> Any:
    """The first true value of ``condition``. Fails with ``what`` if there is none within ``timeout_s``."""
    end = time.monotonic() + timeout_s
    while not (value := condition()):
        assert time.monotonic() < end, what if isinstance(what, str) else what()
        time.sleep(0.02)
    return value


def work_ms(call: Callable[[], Any]) -> float:
    """Milliseconds of this thread's processor time in ``call``: the least of seven, because others compute
    on the same cores."""
    times = []
    for _ in range(7):
        begun = time.thread_time()
        call()
        times.append((time.thread_time() - begun) * 1e3)
    return min(times)


def lines_run(call: Callable[[], Any]) -> int:
    """Lines of Python that ``call`` runs: the same on every machine."""
    count = 0

    def trace(_frame: FrameType, event: str, _arg: Any) -> Any:
        nonlocal count
        count += event == "line"
        return trace

    before = sys.gettrace()
    sys.settrace(trace)
    try:
        call()
    finally:
        sys.settrace(before)
    return count
