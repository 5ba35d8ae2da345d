"""Files that a reader always finds complete: replaced atomically, or appended line by line.

A full disk does not stop a process that appends: lost lines are counted, so a reader knows how many are
missing.
"""

from __future__ import annotations

import argparse
import csv
import json
import logging
import os
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

# Terminates a partly written line, such that no reader of JSON or of tab-separated fields accepts it.
_LINE_SPOILER = b"\t?" * 6 + b"\n"


def write_json(path: Path, data: Any, indent: int | None = None) -> None:
    """Replace ``path`` by ``data`` as JSON; see ``write_bytes``. Raises ValueError for NaN or infinity."""
    write_text(path, json.dumps(data, allow_nan=False, indent=indent) + "\n")


def read_status(path: Path) -> dict[str, Any]:
    """Contents of a JSON status file, which one of our processes replaces regularly; {} if it cannot be read."""
    try:
        found = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_text(path: Path, text: str) -> None:
    """Replace ``path`` by ``text``; see ``write_bytes``."""
    write_bytes(path, text.encode())


def write_bytes(path: Path, data: bytes) -> None:
    """Replace ``path`` atomically: a reader sees the old file or the new one, never a part.

    Safe for any number of threads, processes and machines that share the folder. Raises OSError if the file
    cannot be written; the old one then stays, and no temporary file is left.
    """
    if path.exists() and not path.is_file():  # /dev/stdout, a pipe
        path.write_bytes(data)
        return
    # The process id is not enough: threads share it, and containers that share a folder often do.
    part = path.with_name(f".{path.name}.{os.urandom(6).hex()}.part")
    try:
        part.write_bytes(data)
        os.replace(part, path)
    except BaseException:
        part.unlink(missing_ok=True)
        raise


def write_csv(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file, one mapping a row; a key that a row lacks gives an empty cell. Raises OSError."""
    path.parent.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        writer.writerows(rows)


def out_folder(text: str) -> Path:
    """Argparse type of an output folder, which need not exist yet. Raises ArgumentTypeError."""
    return _to_write(text, is_folder=True)


def out_file(text: str) -> Path:
    """Argparse type of an output file; neither it nor its folder need exist. Raises ArgumentTypeError."""
    return _to_write(text, is_folder=False)


def _to_write(text: str, is_folder: bool) -> Path:
    path = Path(text)
    try:
        text.encode()
    except UnicodeEncodeError:  # neither logs nor reports could name it
        raise argparse.ArgumentTypeError(f"{text!r} is not UTF-8: name another") from None
    there = next(p for p in (path, *path.absolute().parents) if os.path.lexists(p))
    if there == path and not is_folder:
        if path.is_dir():
            raise argparse.ArgumentTypeError(f"{path} is a folder, not a file: name another")
        if path.is_file() and not os.access(path.absolute().parent, os.W_OK | os.X_OK):  # it is replaced
            raise argparse.ArgumentTypeError(f"{path.parent} cannot be written to: name another place")
    elif not there.is_dir():
        raise argparse.ArgumentTypeError(f"{there} is a file, not a folder: name another")
    elif not os.access(there, os.W_OK | os.X_OK):
        raise argparse.ArgumentTypeError(f"{there} cannot be written to: name another place")
    return path


def format_table(rows: Sequence[Mapping[str, Any]]) -> str:
    """Format mappings with the same keys (at least one) as a text table: floats to five digits, numbers
    aligned to the right, text to the left."""
    columns = []
    for name in rows[0]:
        values = [row[name] for row in rows]
        numbers = all(isinstance(value, int | float) for value in values)
        cells = [name, *(f"{value:.5g}" if isinstance(value, float) else str(value) for value in values)]
        width = max(map(len, cells))
        columns.append([cell.rjust(width) if numbers else cell.ljust(width) for cell in cells])
    return "\n".join("  ".join(cells).rstrip() for cells in zip(*columns))


class Lines:
    """Appends whole lines to a file. Thread-safe.

    Each line is a single O_APPEND write, so it survives SIGKILL. Lines that cannot be written are counted in
    ``lost``; the first of them is logged.

    first: line to write on opening, if not empty.
    Raises OSError if the file cannot be opened or ``first`` cannot be written.
    """

    def __init__(self, path: Path, first: str = "") -> None:
        self.path = path
        self.lost = 0
        self._lock = threading.Lock()
        self._fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o644)
        size = os.fstat(self._fd).st_size
        # A writer that was killed may have left half a line; the next one must not continue it.
        self._torn = size > 0 and os.pread(self._fd, 1, size - 1) != b"\n"
        if first and not self.write(first):
            self.close()
            raise OSError(f"{path}: its first line cannot be written; is the disk full?")

    def write(self, line: str) -> bool:
        """Append ``line`` and a newline. False if the line was lost or the file is closed."""
        with self._lock:
            if self._fd < 0:
                return False
            data = (_LINE_SPOILER if self._torn else b"") + line.encode() + b"\n"
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
            log.warning("%s: cannot be written (%s); lines are lost until writing works again", self.path, why)
