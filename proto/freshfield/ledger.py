"""A small append-only account of what happened to each frame, one file per process instance.

Every event is one ``write`` of one line, so what was written survives SIGKILL; at worst the last line is
torn (no newline), and readers drop it. Lines are tab-separated::

    t_ns  camera  session  sequence  event  detail

``t_ns`` is the writing process's clock. File: ``OUT/ledger-<role>-<name>-<start_ns>.tsv``, first line
``#freshfield-ledger 1 <role> <name> <pid>``; roles are ``node``, ``emulator``, ``edge``. A clean exit
writes the event ``closed`` with empty camera.

Events. Node: ``captured``; then ``replaced`` (a newer frame took its place before it was sent) or ``sent``
(handed to the stream; a frame neither replaced nor sent was ``waiting`` when the node ended);
``broken`` (its stream ended before the frame was acknowledged: it may or may not have arrived, what later
processes wrote decides); ``answered`` with the outcome as detail. Emulator: ``received``; then one of
``skipped``, ``dropped_busy``, ``superseded``, ``lost``, ``rejected`` (detail: reason), ``forwarded`` (handed
to the upstream stream; a second ``forwarded`` is a duplicate's copy, announced by ``duplicated``),
``broken`` (upstream was gone). Edge: ``delivered`` or ``rejected`` (detail: reason), once per arriving copy.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

VERSION = 1
ROLES = ("node", "emulator", "edge")


@dataclass(frozen=True)
class Event:
    t_ns: int
    camera: str
    session: str
    sequence: int
    event: str
    detail: str = ""


class Ledger:
    """Writes one process's events. Thread-safe: each event is a single O_APPEND write."""

    def __init__(self, out: Path, role: str, name: str, start_ns: int) -> None:
        if role not in ROLES:
            raise ValueError(f"ledger role {role!r} is not one of {', '.join(ROLES)}")
        out.mkdir(parents=True, exist_ok=True)
        self.path = out / f"ledger-{role}-{name}-{start_ns}.tsv"
        self._fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        os.write(self._fd, f"#freshfield-ledger {VERSION} {role} {name} {os.getpid()}\n".encode())

    def write(
        self, t_ns: int, camera: str, session: str, sequence: int, event: str, detail: str = ""
    ) -> None:
        if self._fd >= 0:
            line = f"{t_ns}\t{camera}\t{session}\t{sequence}\t{event}\t{detail}\n"
            os.write(self._fd, line.encode())

    def close(self, t_ns: int) -> None:
        if self._fd >= 0:
            self.write(t_ns, "", "", 0, "closed")
            os.close(self._fd)
            self._fd = -1


@dataclass(frozen=True)
class LedgerFile:
    path: Path
    role: str
    name: str
    pid: int
    events: tuple[Event, ...]
    torn: bool
    """True if the last line, or any other, could not be read and was left out."""

    @property
    def closed(self) -> bool:
        return bool(self.events) and self.events[-1].event == "closed"


def read(path: Path) -> LedgerFile:
    """Read one ledger, leaving out torn lines. Raises ValueError if it is no ledger of this version."""
    data = path.read_bytes()
    head, _, body = data.partition(b"\n")
    fields = head.decode(errors="replace").split(" ")
    if len(fields) != 5 or fields[0] != "#freshfield-ledger" or fields[1] != str(VERSION):
        raise ValueError(f"{path}: not a freshfield ledger of version {VERSION}")
    events: list[Event] = []
    torn = bool(body) and not body.endswith(b"\n")
    lines = body.split(b"\n")[:-1]
    for line in lines:
        parts = line.decode(errors="replace").split("\t")
        try:
            t_ns, camera, session, sequence, event, detail = parts
            events.append(Event(int(t_ns), camera, session, int(sequence), event, detail))
        except ValueError:
            torn = True
    return LedgerFile(path, fields[2], fields[3], int(fields[4]), tuple(events), torn)


def read_all(out: Path) -> Iterator[LedgerFile]:
    """Every ledger under ``out`` (not recursive), in the order of their names."""
    for path in sorted(out.glob("ledger-*.tsv")):
        yield read(path)
