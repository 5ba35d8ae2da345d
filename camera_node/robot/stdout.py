"""Keeps what libraries print off standard output."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator

_libc = ctypes.CDLL(None)


@contextlib.contextmanager
def only_python_output() -> Iterator[None]:
    """Send what is written to file descriptor 1 to standard error, except Python's own ``print``: ur_rtde,
    for one, writes there from threads of its own when it reconnects."""
    ours = sys.stdout
    ours.flush()
    _libc.fflush(None)
    kept = os.dup(1)
    os.dup2(2, 1)
    try:
        if _descriptor(ours) == 1:
            sys.stdout = os.fdopen(kept, "w", 1, ours.encoding, ours.errors, closefd=False)
        yield
    finally:
        sys.stdout.flush()
        sys.stdout = ours
        _libc.fflush(None)  # what C or C++ still hold goes where it belongs
        os.dup2(kept, 1)
        os.close(kept)


def _descriptor(stream: object) -> int | None:
    """File descriptor of a stream; None where it is no file."""
    try:
        return int(stream.fileno())  # type: ignore[attr-defined]
    except (AttributeError, OSError):
        return None
