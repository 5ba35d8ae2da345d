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
and sent as far as anybody can tell, and is counted so with a note. Where nodes' ledgers are present, a frame
that was only ever refused, of a camera that no process knows or with a garbled id, is nobody's: a stranger,
counted apart. What cannot all be true, such as a frame
both dropped and delivered, is listed in ``contradictions`` and counted once, by the order above. A line
that a killed process had no time to write, or a full disk no room for, is no contradiction: what came after
it stands for it.

Runs are long: ledgers are read a line at a time, and what was written about a frame is kept as the number of
one of the few histories that frames have, each of which is settled once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from freshfield.ledger import LedgerReader

Source = tuple[str, str]

# Ends that a link gives a frame; ``broken`` stands apart because a later process may know better.
LINK_ENDS = ("skipped", "dropped_busy", "superseded", "lost")
ENDS = (*LINK_ENDS, "broken", "delivered", "rejected", "in_flight")
_EVENTS = {
    "node": {"captured", "replaced", "sent", "broken", "answered"},
    "emulator": {"received", *LINK_ENDS, "rejected", "forwarded", "duplicated", "broken"},
    "edge": {"delivered", "rejected"},
}
_ROLES = tuple(_EVENTS)
# What ingest and emulator write in place of an id that they cannot take.
_GARBLED = "?"
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

    def add(self, other: Account, times: int = 1) -> None:
        """Add another account to this one, ``times`` times."""
        for name, value in vars(other).items():
            if name == "rejected":
                for reason, copies in value.items():
                    self.rejected[reason] += copies * times
            else:
                setattr(self, name, getattr(self, name) + value * times)

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
    strangers: Counter[str] = field(default_factory=Counter)
    """Refused frames that no camera here can have sent, by reason; in no other count."""
    notes: list[str] = field(default_factory=list)
    ledgers: int = 0

    def as_dict(self) -> dict[str, Any]:
        """The ``frames`` part of a report."""
        return {
            **self.total.as_dict(),
            "closes": self.total.closes,
            "contradictions": self.contradictions,
            "contradiction_count": self.contradiction_count,
            "strangers": {
                "count": self.strangers.total(),
                "reasons": dict(sorted(self.strangers.items())),
            },
            "by_camera": {camera: account.as_dict() for camera, account in sorted(self.by_camera.items())},
        }


@dataclass(frozen=True)
class _History:
    """Everything written about one frame: how often each role wrote each event, and the reasons."""

    node: Counter[str] = field(default_factory=Counter)
    emulator: Counter[str] = field(default_factory=Counter)
    edge: Counter[str] = field(default_factory=Counter)
    cut_short: frozenset[str] = frozenset()
    """Roles whose ledger for this frame lacks lines: killed before their last ones, or a full disk."""
    last_file: int = -1
    last_depth: int = -1

    def after(self, role: str, event: str, file: int, complete: bool) -> _History:
        """The history with one more event."""
        depth = _ROLES.index(role)
        later = (file, depth) if depth >= self.last_depth else (self.last_file, self.last_depth)
        counts = {name: getattr(self, name) for name in _ROLES}
        counts[role] = counts[role] + Counter([event])
        return _History(**counts, cut_short=self.cut_short | (set() if complete else {role}),
                        last_file=later[0], last_depth=later[1])  # fmt: skip

    @property
    def key(self) -> tuple[Any, ...]:
        """Equal for equal histories, and hashable."""
        counts = (tuple(getattr(self, name).items()) for name in _ROLES)  # in order: the first end counts
        return (*counts, self.cut_short, self.last_file, self.last_depth)


class _Histories:
    """Every history that some frame has or had, by number; 0 is the empty one. A hundred thousand frames
    have a few dozen of them, so a frame costs one number and each step is worked out once."""

    def __init__(self) -> None:
        self.known = [_History()]
        self._numbers = {self.known[0].key: 0}
        self._steps: dict[tuple[int, int, str], int] = {}

    def step(self, number: int, role: str, event: str, file: int, complete: bool) -> int:
        """The number of the history ``number`` with one more event."""
        step = (number, file, event)
        after = self._steps.get(step)
        if after is None:
            history = self.known[number].after(role, event, file, complete)
            after = self._numbers.setdefault(history.key, len(self.known))
            if after == len(self.known):
                self.known.append(history)
            self._steps[step] = after
        return after


@dataclass
class _Heard:
    """What all ledgers say: the number of its history for each frame, by (camera, session) and sequence."""

    histories: _Histories = field(default_factory=_Histories)
    frames: dict[Source, dict[int, int]] = field(default_factory=dict)
    vouched: set[str] = field(default_factory=set)
    """Cameras of which some process wrote more than that it refused a frame."""
    garbled: dict[str, Counter[str]] = field(default_factory=dict)
    """Refusals by reason of what came with an id that cannot be taken, by camera: each is a frame."""
    unknown: Counter[str] = field(default_factory=Counter)


def close_books(out: Path) -> Books:
    """Join every ledger in the folder ``out``. Ledgers that cannot be read are left out and noted."""
    ledgers, notes = [], []
    for path in sorted(out.glob("ledger-*.tsv")):
        try:
            ledgers.append(LedgerReader(path))
        except (ValueError, OSError) as error:
            # Killed before its first line was complete: it had not written about any frame either.
            notes.append(f"{path.name} left out: {error}")
    books = join(ledgers)
    books.notes = notes + books.notes
    return books


def join(ledgers: Sequence[LedgerReader]) -> Books:
    """Join ledgers; any order, any number for each role."""
    books = Books(ledgers=len(ledgers))
    heard = _Heard()
    for number, ledger in enumerate(ledgers):
        books.notes += _hear(heard, number, ledger)
    books.notes += [f"{n} lines with an unknown {what} left out" for what, n in sorted(heard.unknown.items())]

    nodes_here = any(ledger.role == "node" for ledger in ledgers)
    settled = [_settle(history) for history in heard.histories.known]
    stuck: Counter[int] = Counter()
    orphans = 0
    for (camera, session), frames in sorted(heard.frames.items()):
        stranger = nodes_here and camera not in heard.vouched
        told: set[int] = set()
        for number, count in Counter(frames.values()).items():
            history, (account, complaints) = heard.histories.known[number], settled[number]
            if stranger and not history.node:
                for reason, copies in _refusals(history).items():
                    books.strangers[reason] += copies * count
                continue
            books.by_camera.setdefault(camera, Account()).add(account, count)
            orphans += count * (not history.node)
            stuck[history.last_file] += account.in_flight * count
            books.contradiction_count += len(complaints) * count
            if complaints:
                told.add(number)
        if told and len(books.contradictions) < _LISTED:
            for sequence in sorted(s for s, number in frames.items() if number in told):
                lines = [f"{camera} {session} {sequence}: {c}" for c in settled[frames[sequence]][1]]
                books.contradictions += lines[: _LISTED - len(books.contradictions)]
    for camera, refusals in heard.garbled.items():
        if nodes_here:
            books.strangers.update(refusals)
        else:
            count = refusals.total()
            account = Account(captured=count, sent=count, rejected=refusals)
            books.by_camera.setdefault(camera, Account()).add(account)
            orphans += count
    for account in books.by_camera.values():
        books.total.add(account)
    if orphans:
        books.notes.append(f"{orphans} frames have no node's ledger here: counted as captured and sent")
    if books.strangers:
        books.notes.append(f"{books.strangers.total()} frames of unknown origin were refused: counted apart")
    for number, copies in sorted(stuck.items()):
        if copies:
            books.notes.append(f"{copies} in flight, last written by {ledgers[number].path.name}")
    return books


def _hear(heard: _Heard, number: int, ledger: LedgerReader) -> list[str]:
    """Read ledger ``number`` into ``heard``; returns notes."""
    role, name, notes = ledger.role, ledger.path.name, []
    known = _EVENTS.get(role, set())
    step, lost = heard.histories.step, 0
    try:
        complete, closed = ledger.complete, ledger.closed
        for e in ledger:
            event = e.event
            if event in known:
                if event == "rejected":
                    event = f"rejected:{e.detail or 'unknown'}"
                elif event == "answered":
                    event = f"answered:{e.detail.lower().replace('-', '_')}"
                if e.event == "rejected" and _GARBLED in (e.camera, e.session):
                    heard.garbled.setdefault(e.camera, Counter())[e.detail or "unknown"] += 1
                    continue
                if e.event != "rejected":
                    heard.vouched.add(e.camera)
                frames = heard.frames.setdefault((e.camera, e.session), {})
                frames[e.sequence] = step(frames.get(e.sequence, 0), role, event, number, complete)
            elif event == "lost_lines":
                lost += int(e.detail) if e.detail.isdecimal() else 1
            elif event != "closed":
                heard.unknown[f"{role} event {event!r}"] += 1
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
    """Reasons for which copies were rejected, by any process."""
    refusals: Counter[str] = Counter()
    for event, count in [*history.emulator.items(), *history.edge.items()]:
        name, _, reason = event.partition(":")
        if name == "rejected":
            refusals[reason] += count
    return refusals


def _settle(history: _History) -> tuple[Account, list[str]]:
    """The account of one frame, and what cannot be true about it."""
    account = Account()
    node, emulator, edge = history.node, history.emulator, history.edge
    complaints = _node_complaints(history)
    answers = {e.partition(":")[2]: n for e, n in node.items() if e.startswith("answered:")}
    if not (node["sent"] or node["broken"] or answers or emulator or edge):
        account.captured += 1
        account.end("replaced" if node["replaced"] else "waiting")
        return account, complaints

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
    return account, complaints


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
