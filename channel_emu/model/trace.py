"""The trace file: what the link did to every message, one JSON line each.

First line: ``{"freshfield_trace": 2, "seed": ..., "channel": {...}}``. Then one line when a message's outcome
is known::

    {"camera": "cam03", "session": "f3a1", "sequence": 17, "number": 16, "bytes": 20481, "offered_ns": ...,
     "arrived_ns": ..., "outcome": "delivered", "state": 0, "started_ns": ..., "drawn_ns": ..., "due_ns": ...,
     "ended_ns": ..., "actual_ns": ..., "duplicated": false, "flips": []}

Instants are nanoseconds since the emulator started. ``arrived_ns`` is when the message arrived at the server:
at its offer, or later if an arrival process samples messages (null if it was never sampled). ``due_ns`` is
when the link releases the message, ``actual_ns`` when it was handed to gRPC. ``outcome`` is null for a
message that was still inside the link when the recording ended. For services other than the frame stream,
``camera`` is the link's name (``up /pkg.Service/Method``), ``session`` the call and ``sequence`` the
message's index in the call.
"""

from __future__ import annotations

import fcntl
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta

from channel_emu import emulator_constants as tuned
from channel_emu.model.link import MAX_SIZE_BYTES, EventKind, Transit
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.settings import ChannelConfig, channel_from_mapping
from freshfield.untrusted import read_json, read_text

VERSION = 2
Instant = Annotated[int, Meta(ge=0, le=NEVER_NS)]


class TraceError(ValueError):
    """A file that is not a trace, or a trace that cannot be replayed. The message says where."""


class Record(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One offered message: a line of the file, whose fields the module describes."""

    camera: str
    session: str
    sequence: int
    number: Annotated[int, Meta(ge=0)]
    bytes: Annotated[int, Meta(ge=0, le=MAX_SIZE_BYTES)]
    offered_ns: Instant
    arrived_ns: Instant | None
    outcome: EventKind | None
    state: int
    started_ns: Instant | None
    drawn_ns: Instant | None
    due_ns: Instant | None
    ended_ns: Instant | None
    actual_ns: Instant | None = None
    duplicated: bool = False
    flips: tuple[tuple[float, int], ...] = ()


@dataclass(frozen=True)
class Trace:
    """A trace file in memory."""

    seed: int
    config: ChannelConfig
    records: list[Record]

    def by_camera(self) -> dict[str, list[Record]]:
        """Each camera's records by offer number."""
        found: dict[str, list[Record]] = {}
        for record in sorted(self.records, key=lambda r: r.number):
            found.setdefault(record.camera, []).append(record)
        return found


class TraceWriter:
    """Writes a trace file, replacing an older one. If the process is killed, only the last lines are lost. Raises
    TraceError if another emulator writes it, and OSError."""

    def __init__(self, path: Path, config: ChannelConfig, seed: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._lock = path.open("ab")  # does not modify a file that another emulator writes
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            # Devices such as /dev/null may be shared, and some file systems have no locks.
            if isinstance(error, BlockingIOError) and path.is_file():
                self._lock.close()
                raise TraceError(f"{path}: another emulator writes its trace there: name another file") from None
        self._file = path.open("wb", buffering=tuned.TRACE_BUFFER_BYTES)
        self._line({"freshfield_trace": VERSION, "seed": seed, "channel": config.to_mapping()})

    def write(
        self,
        camera: str,
        session: str,
        sequence: int,
        transit: Transit,
        actual_ns: int | None = None,
        duplicated: bool = False,
    ) -> None:
        """Write the line of one message; the module describes its fields."""
        t = transit
        before = (camera, session, sequence, t.number, t.size_bytes, t.offered_ns, t.arrived_ns, t.outcome, t.state)
        after = (t.started_ns, t.drawn_ns, t.due_ns, t.ended_ns, actual_ns, duplicated, t.flips)
        self._line(Record(*before, *after))

    def close(self) -> None:
        self._file.close()
        self._lock.close()

    def _line(self, values: Any) -> None:
        self._file.write(msgspec.json.encode(values) + b"\n")


def read(path: Path) -> Trace:
    """Read a trace, without an incomplete last line. Raises TraceError or ScenarioError if it is unreadable or
    invalid."""
    try:
        lines = read_text(path).split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise TraceError(f"{path}: cannot be read: {error}") from None
    try:
        head = read_json(lines[0])
        version, seed, channel = head["freshfield_trace"], int(head["seed"]), head["channel"]
    except (KeyError, TypeError, ValueError, OverflowError):
        raise TraceError(f"{path}: not a freshfield trace: the first line has no trace header") from None
    if version != VERSION:
        raise TraceError(f"{path}: trace version {version}, expected {VERSION}: record it again")
    config = channel_from_mapping(channel, f"{path}: channel")
    records, decoder = [], msgspec.json.Decoder(Record)
    for number, line in enumerate(lines[1:-1], start=2):
        try:
            records.append(decoder.decode(line))
        except (msgspec.MsgspecError, RecursionError) as error:
            raise TraceError(f"{path}: line {number} is not a trace record: {error}") from None
    return Trace(seed, config, records)
