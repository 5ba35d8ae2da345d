"""Keeps the output of libraries off standard output."""

from __future__ import annotations

import contextlib
import ctypes
import os
import sys
from collections.abc import Iterator

_libc = ctypes.CDLL(None)


@contextlib.contextmanager
def only_python_output() -> Iterator[None]:
    """Redirect file descriptor 1 to standard error, except for Python's own ``print``. ur_rtde, for example,
    writes there from its own threads when it reconnects."""
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
        _libc.fflush(None)  # write the buffers of C and C++ before the descriptor changes
        os.dup2(kept, 1)
        os.close(kept)


def _descriptor(stream: object) -> int | None:
    """File descriptor of a stream; None if it is not a file."""
    try:
        return int(stream.fileno())  # type: ignore[attr-defined]
    except (AttributeError, OSError):
        return None
