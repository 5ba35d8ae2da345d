"""The ledger: what happened to each frame, in one append-only file per process instance.

Every event is one ``write`` of one line, which survives SIGKILL; at worst the last line is incomplete (it has
no newline), and readers drop it. Lines are tab-separated::

    t_ns  camera  session  sequence  event  detail

``t_ns`` is on the writing process's clock. The file is ``OUT/ledger-<role>-<name>-<start_ns>.tsv``, its first
line ``#freshfield-ledger 1 <role> <name> <pid>``; roles are ``node``, ``emulator``, ``edge``.

Events without a camera: ``closed`` at a clean exit (detail: number of lines lost to a full disk, if any), and
``lost_lines`` where lines are missing (detail: their number).

Events of a node:

- ``captured``, then one of ``replaced`` (by a newer frame, before it was sent), ``sent`` (handed to the
  stream) or ``waiting`` (not sent yet when the node exited cleanly);
- after ``sent``: ``answered`` (detail: the outcome) or ``broken`` (the stream ended before an answer; the
  ledgers of later processes tell whether the frame arrived).

Events of the emulator:

- ``received``, then one of ``skipped``, ``dropped_busy``, ``superseded``, ``lost``, ``rejected`` (detail:
  reason), ``forwarded`` (handed to the upstream stream), ``broken`` (upstream was gone) or ``in_flight``
  (inside the link when the emulator exited cleanly);
- ``duplicated`` announces a second ``forwarded`` of the same frame.

Events of the edge: ``delivered`` or ``rejected`` (detail: reason), once per arriving copy.
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
# The last event is searched for in this much of the file's end: many lines.
_TAIL_BYTES = 1 << 16
_HEAD_BYTES = 1 << 12


class Event(NamedTuple):
    """One line. t_ns: on the writing process's clock."""

    t_ns: int
    camera: str
    session: str
    sequence: int
    event: str
    detail: str = ""


class Ledger:
    """Writes the events of one process. Thread-safe: each event is a single O_APPEND write.

    Lines lost to a full disk are counted in ``lines_lost`` and reported in the ledger once it can be written
    again.

    out: folder, created if missing. role: of ROLES. name: of the process, part of the file's name.
    start_ns: start of the process on its clock.
    Raises ValueError for another role, OSError if the file cannot be created.
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

    def write(self, t_ns: int, camera: str, session: str, sequence: int, event: str, detail: str = "") -> None:
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
    """Reads one ledger. Each iteration reads the file again, line by line, in constant memory.

    torn: number of invalid lines that the last iteration skipped.
    unfinished: whether the last line was one of them, without its newline: a killed process had begun it.
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
        if len(fields) != 5 or fields[:2] != ["#freshfield-ledger", str(VERSION)] or not fields[4].isdecimal():
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

    def tail(self) -> list[Event]:
        """The last valid events, found in the file's end."""
        with self.path.open("rb") as file:
            end = file.seek(0, 2)
            start = max(self._body, end - _TAIL_BYTES)
            file.seek(start)
            lines = file.read(end - start).split(b"\n")[:-1]
        whole = lines if start == self._body else lines[1:]
        return [event for line in whole if (event := _parse(line + b"\n")) is not None]

    def last(self) -> Event | None:
        """The last valid event, found in the file's end; None if there is none."""
        return next(reversed(self.tail()), None)

    @property
    def complete(self) -> bool:
        """Whether the process exited cleanly and lost no line, so that missing events did not happen."""
        last = self.last()
        return last is not None and last.event == "closed" and not last.detail

    @property
    def closed(self) -> bool:
        """Whether the process exited cleanly."""
        last = self.last()
        return last is not None and last.event == "closed"


def read_all(out: Path) -> list[LedgerReader]:
    """Every ledger directly in the folder ``out``, sorted by name. Raises as ``LedgerReader``."""
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
