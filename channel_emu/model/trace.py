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

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from channel_emu.model.config import ChannelConfig, channel_from_mapping
from channel_emu.model.link import MAX_SIZE_BYTES, EventKind, Transit
from channel_emu.model.nanoseconds import NEVER_NS
from freshfield.scenario import ScenarioError
from freshfield.untrusted import read_json

VERSION = 2
_INSTANTS = ("offered_ns", "arrived_ns", "started_ns", "drawn_ns", "due_ns", "ended_ns", "actual_ns")
_KINDS = {"camera": str, "session": str, "sequence": int, "number": int, "state": int}


class TraceError(ValueError):
    """A file that is not a trace, or a trace that cannot be replayed. The message says where."""


@dataclass(frozen=True)
class Record:
    """One offered message: a line of the file, whose fields the module describes."""

    camera: str
    session: str
    sequence: int
    number: int
    bytes: int
    offered_ns: int
    arrived_ns: int | None
    outcome: str | None
    state: int
    started_ns: int | None
    drawn_ns: int | None
    due_ns: int | None
    ended_ns: int | None
    actual_ns: int | None = None
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

    def offers(self) -> dict[str, list[tuple[int, int]]]:
        """(instant in ns, bytes) of every offer, by camera."""
        return {name: [(r.offered_ns, r.bytes) for r in found] for name, found in self.by_camera().items()}


class TraceWriter:
    """Writes a trace file, replacing an older one. If the process is killed, only the last lines are lost."""

    def __init__(self, path: Path, config: ChannelConfig, seed: int) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file: TextIO = path.open("w", buffering=1 << 16)
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
        self._line(
            {
                "camera": camera,
                "session": session,
                "sequence": sequence,
                "number": transit.number,
                "bytes": transit.size_bytes,
                "offered_ns": transit.offered_ns,
                "arrived_ns": transit.arrived_ns,
                "outcome": None if transit.outcome is None else str(transit.outcome),
                "state": transit.state,
                "started_ns": transit.started_ns,
                "drawn_ns": transit.drawn_ns,
                "due_ns": transit.due_ns,
                "ended_ns": transit.ended_ns,
                "actual_ns": actual_ns,
                "duplicated": duplicated,
                "flips": transit.flips,
            }
        )

    def close(self) -> None:
        self._file.close()

    def _line(self, values: dict[str, Any]) -> None:
        self._file.write(json.dumps(values, separators=(",", ":")) + "\n")


def read(path: Path) -> Trace:
    """Read a trace, without an incomplete last line. Raises TraceError if it is unreadable or invalid."""
    try:
        lines = path.read_text().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise TraceError(f"{path}: cannot be read: {error}") from None
    try:
        head = read_json(lines[0])
        if head["freshfield_trace"] != VERSION:
            version = head["freshfield_trace"]
            raise TraceError(f"{path}: trace version {version}, expected {VERSION}: record it again")
        config = channel_from_mapping(head["channel"], f"{path}: channel")
        seed = int(head["seed"])
    except (ScenarioError, TraceError):
        raise
    except (KeyError, TypeError, ValueError, OverflowError):
        raise TraceError(f"{path}: not a freshfield trace: the first line has no trace header") from None
    records = []
    for number, line in enumerate(lines[1:-1], start=2):
        try:
            values = read_json(line)
            values["flips"] = tuple((float(place), int(mask)) for place, mask in values["flips"])
            record = Record(**values)
            if any(type(values[key]) is not kind for key, kind in _KINDS.items()):
                raise TypeError
        except (KeyError, TypeError, ValueError, OverflowError):
            raise TraceError(f"{path}: line {number} is not a trace record") from None
        for key in _INSTANTS:
            instant = getattr(record, key)
            if instant is not None and (type(instant) is not int or not 0 <= instant <= NEVER_NS):
                raise TraceError(f"{path}: line {number}: {key}: expected nanoseconds, got {instant!r}")
        if type(record.bytes) is not int or not 0 <= record.bytes <= MAX_SIZE_BYTES:
            raise TraceError(f"{path}: line {number}: bytes: expected a message's size, got {record.bytes!r}")
        if record.outcome is not None and record.outcome not in list(EventKind):
            raise TraceError(f"{path}: line {number}: outcome: unknown, got {record.outcome!r}")
        records.append(record)
    return Trace(seed, config, records)
