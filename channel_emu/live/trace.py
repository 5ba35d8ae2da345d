"""What the link did to every frame, one JSON line each: recorded live, replayed exactly.

First line: ``{"freshfield_trace": 1, "seed": ..., "channel": {...}}``. Then, as fates are settled::

    {"camera": "cam03", "session": "f3a1", "sequence": 17, "number": 16, "bytes": 20481, "offered_ns": ...,
     "outcome": "delivered", "state": 0, "started_ns": ..., "drawn_ns": ..., "due_ns": ..., "ended_ns": ...,
     "actual_ns": ..., "duplicated": false, "flips": []}

Instants are nanoseconds since the emulator started. ``due`` is when the link lets the frame out, ``actual``
when it was handed on. ``outcome`` is null for a frame that was still inside when the recording ended.
"""

from __future__ import annotations

import heapq
import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from channel_emu.model.config import ChannelConfig, channel_from_mapping
from channel_emu.model.instants import NEVER_NS
from channel_emu.model.link import Event, Kind, Transit

VERSION = 1
_INSTANTS = ("offered_ns", "started_ns", "drawn_ns", "due_ns", "ended_ns", "actual_ns")


class TraceError(ValueError):
    """A file that is no trace, or one that cannot be replayed; the message says where."""


@dataclass(frozen=True)
class Record:
    """One offered frame; see the module's description."""

    camera: str
    session: str
    sequence: int
    number: int
    bytes: int
    offered_ns: int
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
        """(instant ns, bytes) of every offer, for ``simulate.replay_offers``."""
        return {name: [(r.offered_ns, r.bytes) for r in found] for name, found in self.by_camera().items()}


class TraceWriter:
    """Appends records to a file; what is written survives the process up to the last few lines."""

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
        self._line({
            "camera": camera, "session": session, "sequence": sequence, "number": transit.number,
            "bytes": transit.size_bytes, "offered_ns": transit.offered_ns,
            "outcome": None if transit.outcome is None else str(transit.outcome), "state": transit.state,
            "started_ns": transit.started_ns, "drawn_ns": transit.drawn_ns, "due_ns": transit.due_ns,
            "ended_ns": transit.ended_ns, "actual_ns": actual_ns, "duplicated": duplicated,
            "flips": transit.flips,
        })  # fmt: skip

    def close(self) -> None:
        self._file.close()

    def _line(self, values: dict[str, Any]) -> None:
        self._file.write(json.dumps(values, separators=(",", ":")) + "\n")


def read(path: Path) -> Trace:
    """Read a trace; a torn last line is left out. Raises TraceError."""
    try:
        lines = path.read_text().split("\n")
    except (OSError, UnicodeDecodeError) as error:
        raise TraceError(f"{path}: cannot be read: {error}") from None
    try:
        head = json.loads(lines[0])
        if head["freshfield_trace"] != VERSION:
            raise TraceError(f"{path}: trace version {head['freshfield_trace']}, expected {VERSION}")
        config = channel_from_mapping(head["channel"], f"{path}: channel")
        seed = int(head["seed"])
    except (json.JSONDecodeError, KeyError, TypeError):
        raise TraceError(f"{path}: not a freshfield trace: the first line has no trace header") from None
    records = []
    for number, line in enumerate(lines[1:-1], start=2):
        try:
            values = json.loads(line)
            values["flips"] = tuple((float(place), int(mask)) for place, mask in values["flips"])
            record = Record(**values)
        except (json.JSONDecodeError, KeyError, TypeError, ValueError):
            raise TraceError(f"{path}: line {number} is not a trace record") from None
        for key in _INSTANTS:
            instant = getattr(record, key)
            if instant is not None and (type(instant) is not int or not 0 <= instant <= NEVER_NS):
                raise TraceError(f"{path}: line {number}: {key}: expected nanoseconds, got {instant!r}")
        if record.outcome is not None and record.outcome not in list(Kind):
            raise TraceError(f"{path}: line {number}: outcome: unknown, got {record.outcome!r}")
        records.append(record)
    return Trace(seed, config, records)


class ReplayLink:
    """A link that repeats a recording: offer ``n`` meets offer ``n``'s recorded fate, as long after its own
    offer as the recorded one did. Offered at the recorded instants it reproduces the recording exactly.

    At the recording's end it starts again from the front. Same interface as ``link.Link``.
    """

    def __init__(self, camera: str, records: list[Record]) -> None:
        if not records:
            raise TraceError(f"the trace holds no frame of {camera}")
        self.camera = camera
        self.counts: Counter[str] = Counter()
        self.offered = 0
        self.clock_backwards = 0
        self.resets = 0
        self.now_ns = 0
        self.chain = None
        self._records = records
        self._agenda: list[tuple[int, int, Kind, Transit]] = []
        self._inside: set[int] = set()
        self._order = 0

    @property
    def in_flight(self) -> int:
        return len(self._inside)

    @property
    def next_event_ns(self) -> int:
        return self._agenda[0][0] if self._agenda else NEVER_NS

    def offer(self, at_ns: int, item: Any = None, size_bytes: int = 0) -> tuple[Transit, list[Event]]:
        events = self.advance(at_ns)
        at_ns = self.now_ns
        record = self._records[self.offered % len(self._records)]
        shift = at_ns - record.offered_ns
        transit = Transit(self.offered, item, size_bytes, at_ns, state=record.state, flips=record.flips)
        self.offered += 1
        self._inside.add(transit.number)
        if record.started_ns is not None and record.due_ns is not None:
            transit.due_ns = min(record.due_ns + shift, NEVER_NS)
            self._plan(record.started_ns + shift, Kind.STARTED, transit)
        outcome, ended_ns = record.outcome, record.ended_ns
        if outcome is None or ended_ns is None:
            # Its end was not recorded; its due was, if it had started.
            outcome = Kind.SUPERSEDED if record.due_ns is None else Kind.DELIVERED
            ended_ns = record.due_ns if record.due_ns is not None else record.offered_ns
        self._plan(ended_ns + shift, Kind(outcome), transit)
        if record.duplicated:
            self._plan(ended_ns + shift, Kind.DUPLICATED, transit)
        return transit, events + self.advance(at_ns)

    def advance(self, to_ns: int) -> list[Event]:
        if to_ns < self.now_ns:
            self.clock_backwards += 1
        self.now_ns = max(self.now_ns, to_ns)
        events = []
        while self._agenda and self._agenda[0][0] <= self.now_ns and self._agenda[0][0] < NEVER_NS:
            at_ns, _, kind, transit = heapq.heappop(self._agenda)
            if kind is Kind.STARTED:
                transit.started_ns = at_ns
            else:
                self.counts[kind] += 1
                if kind is not Kind.DUPLICATED:
                    transit.outcome, transit.ended_ns = kind, at_ns
                    self._inside.discard(transit.number)
            events.append(Event(kind, at_ns, transit))
        return events

    def pending(self) -> list[Transit]:
        """The frames now inside, oldest first."""
        inside = {t.number: t for _, _, _, t in self._agenda if t.number in self._inside}
        return [inside[number] for number in sorted(inside)]

    def _plan(self, at_ns: int, kind: Kind, transit: Transit) -> None:
        self._order += 1
        heapq.heappush(self._agenda, (min(at_ns, NEVER_NS), self._order, kind, transit))


def compare(trace: Trace) -> dict[str, Any]:
    """Decide every recorded offer again in virtual time: {frames, equal, different: [line, ...]}.

    Outcome, start, due and state of each frame must be what was recorded.
    """
    from channel_emu.virtual.simulate import replay_offers

    last_ns = max((max(r.offered_ns, r.started_ns or 0, r.ended_ns or 0) for r in trace.records), default=0)
    again = replay_offers(trace.config, trace.seed, trace.offers(), last_ns)
    different = []
    for camera, records in trace.by_camera().items():
        for record, transit in zip(records, again[camera]):
            outcome = None if transit.outcome is None else str(transit.outcome)
            # A frame still inside when the recording ended may have been settled since.
            same = record.outcome is None or record.outcome == outcome
            if record.started_ns is not None:
                now = (transit.started_ns, transit.due_ns, transit.state)
                same = same and (record.started_ns, record.due_ns, record.state) == now
            if not same:
                then = f"recorded {record.outcome} due {record.due_ns}"
                different.append(f"{camera} {record.sequence}: {then}, now {outcome} due {transit.due_ns}")
    return {
        "frames": len(trace.records),
        "equal": len(trace.records) - len(different),
        "different": different[:20],
    }
