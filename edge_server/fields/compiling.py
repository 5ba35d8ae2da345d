"""Tells people while numba compiles kernels, which takes tens of seconds and would otherwise print nothing.

numba keeps what it compiled (``cache=True``) beside the sources or in ``NUMBA_CACHE_DIR``, for one kind of processor
and one version of the source: a first start compiles, later ones load. It announces each function that it compiles,
but not those that it loads, so a process that says nothing loaded everything.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from numba.core import event

from edge_server.fields.field_constants import COMPILING_EVERY_S

log = logging.getLogger(__name__)

USUAL = "once a machine: usually 90 to 180 functions in 20 to 50 s"
"""Functions: 93 of ``tensorf``, 139 of ``splat`` in layers, 175 with the kernels of depth. Time of ``splat`` in layers:
20 s on a fast core; 35 s on a slow one, 46 with the kernels of depth."""


class Teller(event.Listener):
    """Says how many functions were compiled so far, at most once every ``every_s`` seconds."""

    def __init__(self, say: Callable[[str], None], every_s: float) -> None:
        self._say, self._every_s = say, every_s
        self._count, self._said_s = 0, -every_s

    def on_start(self, event: event.Event) -> None:
        self._count += 1
        now_s = time.perf_counter()
        if now_s - self._said_s >= self._every_s:
            self._said_s = now_s
            self._say(f"compiling the field's kernels ({USUAL}): number {self._count}")

    def on_end(self, event: event.Event) -> None:
        """One compilation may need another: what ends says nothing."""


@contextmanager
def told(say: Callable[[str], None]) -> Iterator[None]:
    """Within it, ``say`` is called with a line for people whenever numba begins to compile a function; from the thread
    that compiles."""
    with event.install_listener("numba:compile", Teller(say, every_s=0.0)):
        yield


_log_teller: Teller | None = None


def log_compilation() -> None:
    """Log, in this process and from now on, that kernels are compiled. Further calls do nothing."""
    global _log_teller
    if _log_teller is None:
        _log_teller = Teller(log.info, COMPILING_EVERY_S)
        event.register("numba:compile", _log_teller)
