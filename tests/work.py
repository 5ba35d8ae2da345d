"""The time a refusal takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

MOST_MS = 50.0
"""Of the work before a refusal: ingest answers every camera on one thread."""


def work_ms(call: Callable[[], Any]) -> float:
    """Milliseconds of this thread's processor time in ``call``: the least of three, because others compute
    on the same cores."""
    times = []
    for _ in range(3):
        begun = time.thread_time()
        call()
        times.append((time.thread_time() - begun) * 1e3)
    return min(times)
