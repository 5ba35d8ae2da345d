"""What happened to each frame: one append-only file per process instance.

Every event is one ``write`` of one line, which survives SIGKILL; at worst the last line is torn (it has no
newline), and readers drop it. Lines are tab-separated::

    t_ns  camera  session  sequence  event  detail

``t_ns`` is the writing process's clock. File: ``OUT/ledger-<role>-<name>-<start_ns>.tsv``, first line
``#freshfield-ledger 1 <role> <name> <pid>``; roles are ``node``, ``emulator``, ``edge``. A clean exit
writes the event ``closed`` with empty camera, and as detail how many lines were lost to a full disk, if any;
``lost_lines``, with a count as detail and empty camera, stands where lines are missing.

Events. Node: ``captured``; then ``replaced`` (a newer frame took its place before it was sent) or ``sent``
(handed to the stream), or ``waiting`` (for its turn when the node ended in order);
``broken`` (its stream ended before the frame was acknowledged: it may or may not have arrived, what later
processes wrote decides); ``answered`` with the outcome as detail. Emulator: ``received``; then one of
``skipped``, ``dropped_busy``, ``superseded``, ``lost``, ``rejected`` (detail: reason), ``forwarded`` (handed
to the upstream stream; a second ``forwarded`` is a duplicate's copy, announced by ``duplicated``),
``broken`` (upstream was gone), ``in_flight`` (inside the link when the emulator ended in order).
Edge: ``delivered`` or ``rejected`` (detail: reason), once per arriving copy.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from freshfield.files import Lines

VERSION = 1
ROLES = ("node", "emulator", "edge")
# The last event is searched for in the end of the file: thousands of lines.
_TAIL_BYTES = 1 << 16
_HEAD_BYTES = 1 << 12


class Event(NamedTuple):
    """One line. t_ns: the writing process's clock."""

    t_ns: int
    camera: str
    session: str
    sequence: int
    event: str
    detail: str = ""


class Ledger:
    """Writes the events of one process. Thread-safe: each event is a single O_APPEND write.

    Lines lost to a full disk are counted in ``lines_lost``, and the ledger says so as soon as there is space
    again. OSError where the file cannot be begun.
    """

    def __init__(self, out: Path, role: str, name: str, start_ns: int) -> None:
        if role not in ROLES:
            raise ValueError(f"ledger role {role!r} is not one of {', '.join(ROLES)}")
        out.mkdir(parents=True, exist_ok=True)
        self.path = out / f"ledger-{role}-{name}-{start_ns}.tsv"
        self._lines = Lines(self.path, f"#freshfield-ledger {VERSION} {role} {name} {os.getpid()}")
        self._lost_reported = 0
        self._reporting = threading.Lock()

    @property
    def lines_lost(self) -> int:
        """Number of lines that could not be written so far."""
        return self._lines.lost

    def write(
        self, t_ns: int, camera: str, session: str, sequence: int, event: str, detail: str = ""
    ) -> None:
        written = self._lines.write(f"{t_ns}\t{camera}\t{session}\t{sequence}\t{event}\t{detail}")
        if written and self._lines.lost > self._lost_reported:
            self._report_lost(t_ns)

    def close(self, t_ns: int) -> None:
        if self._lines.lost > self._lost_reported:
            self._report_lost(t_ns)
        self._lines.write(f"{t_ns}\t\t\t0\tclosed\t{self._lines.lost or ''}")
        self._lines.close()

    def _report_lost(self, t_ns: int) -> None:
        with self._reporting:
            lost = self._lines.lost
            new = lost - self._lost_reported
            if new > 0 and self._lines.write(f"{t_ns}\t\t\t0\tlost_lines\t{new}"):
                self._lost_reported = lost


class LedgerReader:
    """One ledger. Iterating, once or again, reads a line at a time, so that its length takes no memory.

    torn: how many lines the last iteration left out because they could not be read. unfinished: whether one
        of them was the last, without its newline: what a process that was killed had begun to write.
    Raises ValueError if the file is not a ledger of this version, OSError if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.torn = 0
        self.unfinished = False
        with path.open("rb") as file:
            head = file.readline(_HEAD_BYTES)
            self._body = file.tell()
        fields = head.decode(errors="replace").rstrip("\n").split(" ")
        if (
            len(fields) != 5
            or fields[:2] != ["#freshfield-ledger", str(VERSION)]
            or not fields[4].isdecimal()
        ):
            raise ValueError(f"{path}: not a freshfield ledger of version {VERSION}")
        self.role, self.name, self.pid = fields[2], fields[3], int(fields[4])

    def __iter__(self) -> Iterator[Event]:
        self.torn, self.unfinished = 0, False
        with self.path.open("rb") as file:
            file.seek(self._body)
            for line in file:
                event = _parse(line)
                if event is None:
                    self.torn += 1
                    self.unfinished = not line.endswith(b"\n")
                else:
                    yield event

    @property
    def events(self) -> tuple[Event, ...]:
        """All events, in memory."""
        return tuple(self)

    def last(self) -> Event | None:
        """The last event that can be read, found without reading the whole file."""
        with self.path.open("rb") as file:
            end = file.seek(0, 2)
            start = max(self._body, end - _TAIL_BYTES)
            file.seek(start)
            lines = file.read(end - start).split(b"\n")[:-1]
        whole = lines if start == self._body else lines[1:]
        return next((event for line in reversed(whole) if (event := _parse(line + b"\n")) is not None), None)

    @property
    def complete(self) -> bool:
        """Whether the process ended in order and lost no line: what is not written here did not happen."""
        last = self.last()
        return last is not None and last.event == "closed" and not last.detail

    @property
    def closed(self) -> bool:
        """Whether the process ended in order."""
        last = self.last()
        return last is not None and last.event == "closed"


def read_all(out: Path) -> list[LedgerReader]:
    """Every ledger in ``out`` (not in its folders), in the order of their names."""
    return [LedgerReader(path) for path in sorted(out.glob("ledger-*.tsv"))]


def _parse(line: bytes) -> Event | None:
    """The event of one line with its newline; None if it is torn or damaged."""
    if not line.endswith(b"\n"):
        return None
    try:
        t_ns, camera, session, sequence, event, detail = line[:-1].decode(errors="replace").split("\t")
        # The same few names stand in every line: keep one copy of each.
        names = (sys.intern(camera), sys.intern(session), int(sequence), sys.intern(event))
        return Event(int(t_ns), *names, detail)
    except ValueError:
        return None
