"""Joins the ledgers of all processes into an accounting of every frame, in which no term is a remainder.

A frame is (camera, session, sequence). What became of it is what processes wrote. Where they differ, the
process further down the path is believed, because it held the frame later:

1. **edge**: each ``delivered`` or ``rejected`` ends one copy.
2. **emulator**: ``skipped``, ``dropped_busy``, ``superseded``, ``lost`` and ``rejected`` each end a copy that
   the edge has not ended. Then ``broken`` (upstream was gone) ends copies that nothing else has ended.
3. **node**: an ``answered`` that refuses (dropped_busy, superseded, rejected) ends a copy that no later
   process has ended. Then ``broken`` does the same.
4. Otherwise the copy is ``in_flight``: it was sent and no process wrote its end, because the run ended or
   a process was killed meanwhile.

A frame has one copy for each time it was handed to a stream, plus one for each ``duplicated``. The first
copy counts as ``sent``, every other one as ``duplicated``, and each ends in exactly one state. A frame that
was never sent is ``replaced`` if the node wrote so, else ``waiting``. So both sums hold by what was written:

    captured = replaced + waiting + sent
    sent + duplicated = skipped + dropped_busy + superseded + lost + broken + delivered + rejected + in_flight

A frame that only the emulator or the edge wrote about (its node's ledger is on another machine) counts as
captured and sent, with a note. Where nodes' ledgers are present, a frame that was only ever refused, of a
camera that no process accepted or with a garbled id, is of unknown origin and counted apart (``strangers`` in
the report). Statements that cannot all be true, such as a frame both dropped and delivered, are listed in
``contradictions``; the frame counts once, by the order above. A line missing after a kill or from a full disk
is no contradiction: later lines about the frame stand for it.

Runs are long. Ledgers are therefore read line by line, and each frame keeps only the number of its history:
frames share a few dozen different histories, each of which is evaluated once.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from freshfield.ledger import LedgerReader

# Ends that the emulator's link gives a frame. ``broken`` is not one: a later process may know better.
LINK_ENDS = ("skipped", "dropped_busy", "superseded", "lost")
ENDS = (*LINK_ENDS, "broken", "delivered", "rejected", "in_flight")
_EVENTS = {
    "node": {"captured", "replaced", "sent", "broken", "answered"},
    "emulator": {"received", *LINK_ENDS, "rejected", "forwarded", "duplicated", "broken"},
    "edge": {"delivered", "rejected"},
}
_ROLES = tuple(_EVENTS)
# What the edge and the emulator write in place of an id that they cannot accept.
_GARBLED = "?"
# Enough to see what went wrong; the count says how often.
_MAX_LISTED = 20


@dataclass
class FrameCounts:
    """Counts of frames and copies by state; ``rejected`` by reason."""

    captured: int = 0
    replaced: int = 0
    waiting: int = 0
    sent: int = 0
    skipped: int = 0
    dropped_busy: int = 0
    superseded: int = 0
    lost: int = 0
    broken: int = 0
    duplicated: int = 0
    delivered: int = 0
    rejected: Counter[str] = field(default_factory=Counter)
    in_flight: int = 0

    def count_end(self, state: str, copies: int = 1) -> None:
        """Count copies that ended in ``state``; a rejection is written ``rejected:reason``."""
        name, _, reason = state.partition(":")
        if not copies:
            return  # the report lists no reason for which nothing was rejected
        if name == "rejected":
            self.rejected[reason or "unknown"] += copies
        else:
            setattr(self, name, getattr(self, name) + copies)

    def add(self, other: FrameCounts, times: int = 1) -> None:
        """Add ``other`` to these counts, ``times`` times."""
        for name, value in vars(other).items():
            if name == "rejected":
                for reason, copies in value.items():
                    self.rejected[reason] += copies * times
            else:
                setattr(self, name, getattr(self, name) + value * times)

    @property
    def balanced(self) -> bool:
        """Whether both sums of the module's docstring hold."""
        ended = sum(getattr(self, name) for name in ENDS if name != "rejected") + self.rejected.total()
        return (
            self.captured == self.replaced + self.waiting + self.sent and self.sent + self.duplicated == ended
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, in the order in which a frame passes the states."""
        return {**vars(self), "rejected": dict(sorted(self.rejected.items()))}


@dataclass
class FrameAccounting:
    """What became of every frame of a run.

    unknown_origin: refused frames that no camera of the run can have sent, by reason; in no other count.
    notes: one line for people on whatever was missing, torn or assumed. ledgers: how many were read.
    """

    total: FrameCounts = field(default_factory=FrameCounts)
    by_camera: dict[str, FrameCounts] = field(default_factory=dict)
    contradictions: list[str] = field(default_factory=list)
    contradiction_count: int = 0
    unknown_origin: Counter[str] = field(default_factory=Counter)
    notes: list[str] = field(default_factory=list)
    ledgers: int = 0

    def as_dict(self) -> dict[str, Any]:
        """The ``frames`` part of a report."""
        reasons = dict(sorted(self.unknown_origin.items()))
        return {
            **self.total.as_dict(),
            "closes": self.total.balanced,
            "contradictions": self.contradictions,
            "contradiction_count": self.contradiction_count,
            "strangers": {"count": self.unknown_origin.total(), "reasons": reasons},
            "by_camera": {camera: counts.as_dict() for camera, counts in sorted(self.by_camera.items())},
        }

    def add(self, camera: str, counts: FrameCounts, times: int = 1) -> None:
        """Add ``counts`` to a camera and to the total, ``times`` times."""
        self.by_camera.setdefault(camera, FrameCounts()).add(counts, times)
        self.total.add(counts, times)


@dataclass(frozen=True)
class _History:
    """Everything written about one frame: how often each role wrote each event (a rejection or an answer with
    its reason). incomplete: roles whose ledger for this frame may lack lines (killed, or a full disk).
    last_file, last_role: the ledger and the role furthest down the path that wrote about it."""

    node: Counter[str] = field(default_factory=Counter)
    emulator: Counter[str] = field(default_factory=Counter)
    edge: Counter[str] = field(default_factory=Counter)
    incomplete: frozenset[str] = frozenset()
    last_file: int = -1
    last_role: int = -1

    def after(self, role: str, event: str, file: int, complete: bool) -> _History:
        """The history with one more event."""
        number = _ROLES.index(role)
        last = (file, number) if number >= self.last_role else (self.last_file, self.last_role)
        counts = {name: getattr(self, name) for name in _ROLES}
        counts[role] = counts[role] + Counter([event])
        return _History(**counts, incomplete=self.incomplete | (set() if complete else {role}),
                        last_file=last[0], last_role=last[1])  # fmt: skip

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for equal histories, and hashable."""
        counts = (tuple(getattr(self, name).items()) for name in _ROLES)  # in order: the first end counts
        return (*counts, self.incomplete, self.last_file, self.last_role)


class _Histories:
    """Every different history, by number; 0 is the empty one. A hundred thousand frames share a few dozen, so
    a frame costs one number and each transition is computed once."""

    def __init__(self) -> None:
        self.all = [_History()]
        self._numbers = {self.all[0].key: 0}
        self._transitions: dict[tuple[int, int, str], int] = {}

    def after(self, number: int, role: str, event: str, file: int, complete: bool) -> int:
        """The number of history ``number`` with one more event."""
        transition = (number, file, event)
        result = self._transitions.get(transition)
        if result is None:
            history = self.all[number].after(role, event, file, complete)
            result = self._numbers.setdefault(history.key, len(self.all))
            if result == len(self.all):
                self.all.append(history)
            self._transitions[transition] = result
        return result


@dataclass
class _LedgerContents:
    """What all ledgers say.

    frames: number of each frame's history, by (camera, session) and sequence. accepted: cameras about which
    some process wrote more than refusals. garbled: by camera, the reasons for which frames with a garbled id
    were refused; each is one frame. unknown_events: how often each event that no role writes was read.
    """

    histories: _Histories = field(default_factory=_Histories)
    frames: dict[tuple[str, str], dict[int, int]] = field(default_factory=dict)
    accepted: set[str] = field(default_factory=set)
    garbled: dict[str, Counter[str]] = field(default_factory=dict)
    unknown_events: Counter[str] = field(default_factory=Counter)


def account_frames(out: Path) -> FrameAccounting:
    """Join every ledger in the folder ``out``. Ledgers that cannot be read are left out and noted."""
    ledgers, notes = [], []
    for path in sorted(out.glob("ledger-*.tsv")):
        try:
            ledgers.append(LedgerReader(path))
        except (ValueError, OSError) as error:
            # Killed before its first line was complete: it had not written about any frame either.
            notes.append(f"{path.name} left out: {error}")
    accounting = FrameAccounting(ledgers=len(ledgers), notes=notes)
    contents = _LedgerContents()
    for number, ledger in enumerate(ledgers):
        notes += _read_ledger(contents, number, ledger)
    unknown = sorted(contents.unknown_events.items())
    notes += [f"{count} lines with an unknown {event} left out" for event, count in unknown]

    has_node_ledger = any(ledger.role == "node" for ledger in ledgers)
    evaluated = [_evaluate(history) for history in contents.histories.all]
    in_flight_at: Counter[int] = Counter()
    without_node = 0
    for (camera, session), frames in sorted(contents.frames.items()):
        contradicting: set[int] = set()
        for number, count in Counter(frames.values()).items():
            history, (counts, contradictions) = contents.histories.all[number], evaluated[number]
            if has_node_ledger and camera not in contents.accepted and not history.node:
                for reason, copies in _refusals(history).items():
                    accounting.unknown_origin[reason] += copies * count
                continue
            accounting.add(camera, counts, count)
            without_node += count * (not history.node)
            in_flight_at[history.last_file] += counts.in_flight * count
            accounting.contradiction_count += len(contradictions) * count
            if contradictions:
                contradicting.add(number)
        listed = accounting.contradictions
        if contradicting and len(listed) < _MAX_LISTED:
            for sequence in sorted(s for s, number in frames.items() if number in contradicting):
                lines = [f"{camera} {session} {sequence}: {c}" for c in evaluated[frames[sequence]][1]]
                listed += lines[: _MAX_LISTED - len(listed)]
    for camera, refusals in contents.garbled.items():
        if has_node_ledger:
            accounting.unknown_origin.update(refusals)
        else:
            count = refusals.total()
            accounting.add(camera, FrameCounts(captured=count, sent=count, rejected=refusals))
            without_node += count
    if without_node:
        notes.append(f"{without_node} frames have no node's ledger here: counted as captured and sent")
    if accounting.unknown_origin:
        count = accounting.unknown_origin.total()
        notes.append(f"{count} frames of unknown origin were refused: counted apart")
    for number, copies in sorted(in_flight_at.items()):
        if copies:
            notes.append(f"{copies} in flight, last written by {ledgers[number].path.name}")
    return accounting


def _read_ledger(contents: _LedgerContents, number: int, ledger: LedgerReader) -> list[str]:
    """Read ledger ``number`` into ``contents``; returns notes."""
    role, name, notes = ledger.role, ledger.path.name, []
    known = _EVENTS.get(role, set())
    after, lost = contents.histories.after, 0
    try:
        complete, closed = ledger.complete, ledger.closed
        for e in ledger:
            event = e.event
            if event in known:
                if event == "answered":
                    event = f"answered:{e.detail.lower().replace('-', '_')}"
                elif event == "rejected":
                    reason = e.detail or "unknown"
                    if _GARBLED in (e.camera, e.session):
                        contents.garbled.setdefault(e.camera, Counter())[reason] += 1
                        continue
                    event = f"rejected:{reason}"
                if e.event != "rejected":
                    contents.accepted.add(e.camera)
                frames = contents.frames.setdefault((e.camera, e.session), {})
                frames[e.sequence] = after(frames.get(e.sequence, 0), role, event, number, complete)
            elif event == "lost_lines":
                lost += int(e.detail) if e.detail.isdecimal() else 1
            elif event != "closed":
                contents.unknown_events[f"{role} event {event!r}"] += 1
    except OSError as error:
        return [f"{name}: read in part: {error}"]
    if ledger.torn:
        notes.append(f"{name}: unreadable line left out (killed while writing, or a full disk)")
    if lost:
        notes.append(f"{name}: {lost} lines were lost while it could not be written (a full disk?)")
    if not closed:
        notes.append(f"{name}: not closed (killed, or still running)")
    return notes


def _refusals(history: _History) -> Counter[str]:
    """How often emulator and edge rejected copies of the frame, by reason."""
    refusals: Counter[str] = Counter()
    for event, count in [*history.emulator.items(), *history.edge.items()]:
        name, _, reason = event.partition(":")
        if name == "rejected":
            refusals[reason] += count
    return refusals


def _evaluate(history: _History) -> tuple[FrameCounts, list[str]]:
    """The counts of one frame, and what cannot be true about it."""
    counts = FrameCounts()
    node, emulator, edge = history.node, history.emulator, history.edge
    contradictions = _node_contradictions(history)
    answers = {e.partition(":")[2]: n for e, n in node.items() if e.startswith("answered:")}
    if not (node["sent"] or node["broken"] or answers or emulator or edge):
        counts.captured += 1
        counts.count_end("replaced" if node["replaced"] else "waiting")
        return counts, contradictions

    arrived, forwarded = edge.total(), emulator["forwarded"]
    if node:
        frames, handed = 1, max(1, node["sent"])
    else:
        # No ledger here says how often it was sent: each arrival at the first known hop counts as one.
        frames = handed = emulator["received"] or (1 if emulator else arrived)
    copies = handed + emulator["duplicated"]
    if arrived > copies:
        contradictions.append(f"reached the edge {arrived} times but only {copies} copies were made")
        copies = arrived
    if emulator and arrived > forwarded and "emulator" not in history.incomplete:
        contradictions.append(f"reached the edge {arrived} times but was forwarded {forwarded} times")
    if emulator["received"] > handed:
        contradictions.append(f"received {emulator['received']} times but sent {handed} times")

    counts.captured += frames
    counts.sent += frames
    counts.duplicated += copies - frames
    left = copies
    for end, count in edge.items():
        counts.count_end(end, count)
        left -= count
    ends = {e: n for e, n in emulator.items() if _is_end(e)}
    for end, count in ends.items():
        counted = min(count, left)
        counts.count_end(end, counted)
        left -= counted
        if counted < count:
            contradictions.append(f"{end} {count} times at the emulator, with {counted} copies left to end")
    if forwarded + sum(ends.values()) > copies:
        contradictions.append(
            f"{copies} copies, but {forwarded} forwarded and {sum(ends.values())} ended before"
        )
    for answer, count in answers.items():
        if _is_end(answer):
            counted = min(count, left)
            counts.count_end(answer, counted)
            left -= counted
    broken = min(left, emulator["broken"] or node["broken"])
    counts.count_end("broken", broken)
    counts.count_end("in_flight", left - broken)
    return counts, contradictions


def _is_end(event: str) -> bool:
    return event in LINK_ENDS or event.startswith("rejected")


def _node_contradictions(history: _History) -> list[str]:
    node = history.node
    if not node:
        return []
    contradictions = []
    if node["captured"] != 1:
        contradictions.append(f"the node wrote captured {node['captured']} times")
    arrived = history.emulator or history.edge
    if node["replaced"] and (node["sent"] or arrived):
        contradictions.append("replaced at the node, yet sent")
    elif not node["sent"] and arrived and "node" not in history.incomplete:
        contradictions.append("arrived, but the node never wrote that it was sent")
    return contradictions
