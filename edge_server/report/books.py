"""Joins the ledgers of all processes into one account of every frame, in which no term is a remainder.

A frame is (camera, session, sequence). Its account rests on what processes wrote, and where they differ the
one further down the way is believed, because it held the frame later:

1. **edge**: each ``delivered`` or ``rejected`` is the end of one copy.
2. **emulator**: ``skipped``, ``dropped_busy``, ``superseded``, ``lost`` and ``rejected`` end a copy that
   the edge has not ended; then ``broken`` (upstream was gone) ends one that nothing else has.
3. **node**: an ``answered`` that refuses (dropped_busy, superseded, rejected) ends a copy that nobody after
   it has ended, as does then ``broken``.
4. Otherwise the copy is ``in_flight``: it was sent and no process wrote its end, because the run ended or
   a process was killed while it was on its way.

A frame has as many copies as it was handed to a stream, plus one for each ``duplicated``; the first is its
``sent``, every other is counted ``duplicated``, and each copy ends in exactly one state. A frame that was
never sent is ``replaced`` if the node said so, else ``waiting``. So both sums close by what was written:

    captured = replaced + waiting + sent
    sent + duplicated = skipped + dropped_busy + superseded + lost + broken + delivered + rejected + in_flight

A frame known to the emulator or the edge alone (its node's ledger lies on another machine) was captured
and sent as far as anybody can tell, and is counted so with a note. What cannot all be true, such as a frame
both dropped and delivered, is listed in ``contradictions`` and counted once, by the order above. A line
that a killed process had no time to write is no contradiction: what came after it stands for it.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from freshfield.ledger import LedgerFile, read

Key = tuple[str, str, int]

# Ends that a link gives a frame; ``broken`` stands apart because a later process may know better.
LINK_ENDS = ("skipped", "dropped_busy", "superseded", "lost")
ENDS = (*LINK_ENDS, "broken", "delivered", "rejected", "in_flight")
_EVENTS = {
    "node": {"captured", "replaced", "sent", "broken", "answered"},
    "emulator": {"received", *LINK_ENDS, "rejected", "forwarded", "duplicated", "broken"},
    "edge": {"delivered", "rejected"},
}
# Enough to see what kind of thing went wrong; the count says how often.
_LISTED = 20


@dataclass
class Account:
    """Counts of frames and copies; ``rejected`` by reason."""

    captured: int = 0
    replaced: int = 0
    waiting: int = 0
    sent: int = 0
    duplicated: int = 0
    skipped: int = 0
    dropped_busy: int = 0
    superseded: int = 0
    lost: int = 0
    broken: int = 0
    delivered: int = 0
    in_flight: int = 0
    rejected: Counter[str] = field(default_factory=Counter)

    def end(self, state: str, copies: int = 1) -> None:
        """Count copies that ended in ``state``; a rejection is written ``rejected:reason``."""
        name, _, reason = state.partition(":")
        if not copies:
            return  # a reason nobody was rejected for has no place in the report
        if name == "rejected":
            self.rejected[reason or "unknown"] += copies
        else:
            setattr(self, name, getattr(self, name) + copies)

    def add(self, other: Account) -> None:
        """Add another account to this one."""
        for name, value in vars(other).items():
            if name == "rejected":
                self.rejected.update(value)
            else:
                setattr(self, name, getattr(self, name) + value)

    @property
    def closes(self) -> bool:
        """Both sums of the module's docstring hold."""
        ended = sum(getattr(self, name) for name in ENDS if name != "rejected") + self.rejected.total()
        return (
            self.captured == self.replaced + self.waiting + self.sent and self.sent + self.duplicated == ended
        )

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, in the order of a frame's way."""
        order = ("captured", "replaced", "waiting", "sent", *LINK_ENDS, "broken", "duplicated", "delivered")
        counts: dict[str, Any] = {name: getattr(self, name) for name in order}
        counts["rejected"] = dict(sorted(self.rejected.items()))
        counts["in_flight"] = self.in_flight
        return counts


@dataclass
class Books:
    """The joined account. notes: what was missing, torn or assumed, one line each, for people."""

    total: Account = field(default_factory=Account)
    by_camera: dict[str, Account] = field(default_factory=dict)
    contradictions: list[str] = field(default_factory=list)
    contradiction_count: int = 0
    notes: list[str] = field(default_factory=list)
    ledgers: int = 0

    def as_dict(self) -> dict[str, Any]:
        """The ``frames`` part of a report."""
        return {
            **self.total.as_dict(),
            "closes": self.total.closes,
            "contradictions": self.contradictions,
            "contradiction_count": self.contradiction_count,
            "by_camera": {camera: account.as_dict() for camera, account in sorted(self.by_camera.items())},
        }


@dataclass
class _History:
    """Everything written about one frame: how often each role wrote each event, and the reasons."""

    node: Counter[str] = field(default_factory=Counter)
    emulator: Counter[str] = field(default_factory=Counter)
    edge: Counter[str] = field(default_factory=Counter)
    cut_short: set[str] = field(default_factory=set)
    """Roles whose ledger for this frame was never closed: their last lines may be missing."""
    last_file: int = -1
    last_depth: int = -1

    def note(self, role: str, event: str, detail: str, file: int, closed: bool) -> None:
        if event == "rejected":
            event = f"rejected:{detail or 'unknown'}"
        elif event == "answered":
            event = f"answered:{detail.lower().replace('-', '_')}"
        getattr(self, role)[event] += 1
        if not closed:
            self.cut_short.add(role)
        depth = ("node", "emulator", "edge").index(role)
        if depth >= self.last_depth:
            self.last_file, self.last_depth = file, depth


def close_books(out: Path) -> Books:
    """Join every ledger in the folder ``out``. Ledgers that cannot be read are left out and noted."""
    files, notes = [], []
    for path in sorted(out.glob("ledger-*.tsv")):
        try:
            files.append(read(path))
        except (ValueError, OSError) as error:
            # Killed before its first line was complete: it had not written about any frame either.
            notes.append(f"{path.name} left out: {error}")
    books = join(files)
    books.notes = notes + books.notes
    return books


def join(files: Iterable[LedgerFile]) -> Books:
    """Join ledgers that were read already; any order, any number for each role."""
    books = Books()
    ledgers = list(files)
    books.ledgers = len(ledgers)
    frames: dict[Key, _History] = defaultdict(_History)
    unknown: Counter[str] = Counter()
    for number, ledger in enumerate(ledgers):
        if ledger.torn:
            books.notes.append(f"{ledger.path.name}: unreadable line left out (killed while writing)")
        if not ledger.closed:
            books.notes.append(f"{ledger.path.name}: not closed (killed, or still running)")
        known = _EVENTS.get(ledger.role, set())
        for e in ledger.events:
            if e.event in known:
                history = frames[e.camera, e.session, e.sequence]
                history.note(ledger.role, e.event, e.detail, number, ledger.closed)
            elif e.event != "closed":
                unknown[f"{ledger.role} event {e.event!r}"] += 1
    books.notes += [f"{n} lines with an unknown {what} left out" for what, n in sorted(unknown.items())]

    stuck: Counter[int] = Counter()
    strangers = 0
    for key, history in sorted(frames.items()):
        account = books.by_camera.setdefault(key[0], Account())
        in_flight = account.in_flight
        strangers += not history.node
        for complaint in _settle(history, account):
            books.contradiction_count += 1
            if len(books.contradictions) < _LISTED:
                books.contradictions.append(f"{key[0]} {key[1]} {key[2]}: {complaint}")
        if account.in_flight > in_flight:
            stuck[history.last_file] += account.in_flight - in_flight
    for account in books.by_camera.values():
        books.total.add(account)
    if strangers:
        books.notes.append(f"{strangers} frames have no node's ledger here: counted as captured and sent")
    for number, copies in sorted(stuck.items()):
        books.notes.append(f"{copies} in flight, last written by {ledgers[number].path.name}")
    return books


def _settle(history: _History, account: Account) -> list[str]:
    """Count one frame in ``account``; returns what cannot be true about it."""
    node, emulator, edge = history.node, history.emulator, history.edge
    complaints = _node_complaints(history)
    answers = {e.partition(":")[2]: n for e, n in node.items() if e.startswith("answered:")}
    if not (node["sent"] or node["broken"] or answers or emulator or edge):
        account.captured += 1
        account.end("replaced" if node["replaced"] else "waiting")
        return complaints

    arrived, forwarded = edge.total(), emulator["forwarded"]
    if node:
        frames, handed = 1, max(1, node["sent"])
    else:
        # Nobody here knows how often it was sent: every arrival at the first known hop is one.
        frames = handed = emulator["received"] or (1 if emulator else arrived)
    copies = handed + emulator["duplicated"]
    if arrived > copies:
        complaints.append(f"reached the edge {arrived} times but only {copies} copies were made")
        copies = arrived
    if emulator and arrived > forwarded and "emulator" not in history.cut_short:
        complaints.append(f"reached the edge {arrived} times but was forwarded {forwarded} times")
    if emulator["received"] > handed:
        complaints.append(f"received {emulator['received']} times but sent {handed} times")

    account.captured += frames
    account.sent += frames
    account.duplicated += copies - frames
    left = copies
    for end, count in edge.items():
        account.end(end, count)
        left -= count
    ends = {e: n for e, n in emulator.items() if e in LINK_ENDS or e.startswith("rejected:")}
    for end, count in ends.items():
        counted = min(count, left)
        account.end(end, counted)
        left -= counted
        if counted < count:
            complaints.append(f"{end} {count} times at the emulator, with {counted} copies left to end")
    if forwarded + sum(ends.values()) > copies:
        complaints.append(f"{copies} copies, but {forwarded} forwarded and {sum(ends.values())} ended before")
    for answer, count in answers.items():
        if answer in LINK_ENDS or answer.startswith("rejected"):
            counted = min(count, left)
            account.end(answer, counted)
            left -= counted
    broken = min(left, emulator["broken"] or node["broken"])
    account.end("broken", broken)
    account.end("in_flight", left - broken)
    return complaints


def _node_complaints(history: _History) -> list[str]:
    node = history.node
    if not node:
        return []
    complaints = []
    if node["captured"] != 1:
        complaints.append(f"the node wrote captured {node['captured']} times")
    if node["replaced"] and (node["sent"] or history.emulator or history.edge):
        complaints.append("replaced at the node, yet sent")
    elif not node["sent"] and (history.emulator or history.edge) and "node" not in history.cut_short:
        complaints.append("arrived, but the node never wrote that it was sent")
    return complaints
