"""Files that are whole whenever somebody looks: replaced at once, or grown line by line.

A full disk costs what could not be written, never the process that writes: appended lines that were lost are
counted, so that an account can say that it is not complete.
"""

from __future__ import annotations

import json
import logging
import os
import secrets
import threading
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

# Ends a line of which only a part was written, in such a way that no reader of JSON or of tab-separated
# fields takes the part for the whole.
_SPOIL = b"\t?" * 6 + b"\n"


def write_json(path: Path, data: Any, indent: int | None = None) -> None:
    """Replace ``path`` by ``data`` as JSON; see ``write_text``. ValueError for NaN, which JSON lacks."""
    write_text(path, json.dumps(data, allow_nan=False, indent=indent) + "\n")


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by ``text``; see ``write_bytes``."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Replace ``path`` at once: a reader sees the old file or the new one, never half of one.

    Any number of threads, processes and machines sharing the folder may do so. OSError where it cannot be
    written; the old file is then untouched and nothing is left beside it.
    """
    # The process id is not enough: threads share it, and containers that share a folder often do.
    part = path.with_name(f".{path.name}.{secrets.token_hex(6)}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


class Lines:
    """Appends whole lines to a file. Thread-safe; each line is a single O_APPEND write, so that what was
    written survives SIGKILL. A line that cannot be written is counted in ``lost`` and said once in the log.

    first: written at once; OSError if that, or opening the file, fails.
    """

    def __init__(self, path: Path, first: str = "") -> None:
        self.path = path
        self.lost = 0
        """Lines that could not be written."""
        self._lock = threading.Lock()
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        size = os.fstat(self._fd).st_size
        # A writer that was killed may have left half a line, which must not swallow the next one.
        self._torn = size > 0 and os.pread(self._fd, 1, size - 1) != b"\n"
        if first and not self.write(first):
            self.close()
            raise OSError(f"{path}: its first line cannot be written; is the disk full?")

    def write(self, line: str) -> bool:
        """Append ``line`` (without its newline); False if it is lost, or the file is closed."""
        with self._lock:
            if self._fd < 0:
                return False
            data = (_SPOIL if self._torn else b"") + line.encode() + b"\n"
            try:
                written = os.write(self._fd, data)
            except OSError as error:
                self._lose(error.strerror or str(error))
                return False
            if written < len(data):
                self._torn = self._torn or written > 0
                self._lose("the disk took only a part of a line")
                return False
            self._torn = False
            return True

    def close(self) -> None:
        with self._lock:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1

    def _lose(self, why: str) -> None:
        self.lost += 1
        if self.lost == 1:
            log.warning("%s: cannot be written (%s); lines are lost until it can be again", self.path, why)
