"""Joins the ledgers of all processes into an account of every frame; every term is counted separately.

A frame is (camera, session, sequence). Its outcome follows from what processes wrote. Both sums must hold for
the written events; no term is computed as a remainder:

    captured = replaced + waiting + sent
    sent + duplicated = skipped + dropped_busy + superseded + lost + broken + delivered + rejected
                        + in_flight + cut_off

A frame has one copy for each time it was handed to a stream, plus one for each ``duplicated``. The first
copy counts as ``sent``, every other one as ``duplicated``. Ends of copies:

1. **edge**: each ``delivered`` or ``rejected`` ends one copy.
2. **emulator**: ``skipped``, ``dropped_busy``, ``superseded``, ``lost``, ``rejected`` and ``in_flight``
   (inside the link when the emulator ended) each end one copy.
3. Second-hand statements count only for copies that the above have not ended, because a process further down
   the path held the frame later: a refusal in the node's ``answered``, then ``broken``.
4. ``cut_off``: no process wrote the end, and a process that may have held the copy was killed or still runs:
   its ledger ends without ``closed``, and a line about the frame is within ``CUT_OFF_NS`` of that end (on the
   line's clock). A frame that such a node captured last and did not send counts as ``waiting``.

A copy without any end is in no term, so the second sum then fails. ``doubts`` explains why an account does not close:
a sum that does not match, statements that cannot all be true (``contradictions``, such as a frame both dropped and
delivered), lost ledger lines, unreadable ledgers.

A frame that only the emulator or the edge wrote about (its node's ledger is on another machine) counts as
captured and sent, with a note. Two kinds are of unknown origin and counted separately (``strangers`` in the report):
frames with a garbled id; and, if nodes' ledgers are present, frames that were only ever refused, of a camera that no
process accepted or of a session whose node did not write about it.

Runs are long. Ledgers are therefore read line by line, and each frame keeps only the number of its history:
frames share a few dozen different histories, each of which is evaluated once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from edge_server.report.report_constants import CUT_OFF_NS, MOST_CONTRADICTIONS
from freshfield.ledger import Event, LedgerReader

# Ends that the emulator's link gives a frame. ``broken`` is not one: a later process may know better.
LINK_ENDS = ("skipped", "dropped_busy", "superseded", "lost", "in_flight")
ENDS = (*LINK_ENDS, "broken", "delivered", "rejected", "cut_off")
_ON_THE_WAY = ("captured", "replaced", "waiting", "sent", "skipped", "dropped_busy", "superseded", "lost", "broken")
_STATES = (*_ON_THE_WAY, "duplicated", "delivered", "rejected", "in_flight", "cut_off")
_EVENTS = {
    "node": {"captured", "replaced", "waiting", "sent", "broken", "answered"},
    "emulator": {"received", *LINK_ENDS, "rejected", "forwarded", "duplicated", "broken"},
    "edge": {"delivered", "rejected"},
}
_ROLES = tuple(_EVENTS)
# What the edge and the emulator write in place of an id that they cannot accept.
_GARBLED = "?"


class FrameCounts(Counter[str]):
    """Counts of frames and copies by state; of a rejection by ``rejected:reason``."""

    def add(self, other: Mapping[str, int], times: int = 1) -> None:
        """Add ``other`` to these counts, ``times`` times."""
        for state, count in other.items():
            self[state] += count * times

    @property
    def without_end(self) -> tuple[int, int]:
        """Frames captured and copies sent that have no end by the sums of the module's docstring: both 0 if the sums
        hold, negative if more ended than there were."""
        ended = sum(count for state, count in self.items() if state.partition(":")[0] in ENDS)
        unsent = self["captured"] - self["replaced"] - self["waiting"] - self["sent"]
        return unsent, self["sent"] + self["duplicated"] - ended

    def as_dict(self) -> dict[str, Any]:
        """Plain numbers, in the order in which a frame passes the states; ``rejected`` by reason."""
        ends = sorted((state.partition(":")[2], n) for state, n in self.items() if state.startswith("rejected:") and n)
        return {**{state: self[state] for state in _STATES}, "rejected": dict(ends)}


@dataclass
class FrameAccounting:
    """The outcome of every frame of a run.

    total, by_camera: counts of frames and copies.
    contradictions: the first of the statements that cannot all be true. contradiction_count: number of all.
    unknown_origin: refused frames that no camera of the run can have sent, by reason; in no other count.
    lines_lost: ledger lines that were not written or cannot be read.
    unreadable: names of ledgers that cannot be read to their end.
    notes: lines of text on what was missing, torn or assumed.
    ledgers: number of ledgers read.
    """

    total: FrameCounts = field(default_factory=FrameCounts)
    by_camera: dict[str, FrameCounts] = field(default_factory=dict)
    contradictions: list[str] = field(default_factory=list)
    contradiction_count: int = 0
    unknown_origin: Counter[str] = field(default_factory=Counter)
    lines_lost: int = 0
    unreadable: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    ledgers: int = 0

    @property
    def doubts(self) -> list[str]:
        """Why not every frame is accounted for, one line each; empty if the account closes."""
        per_camera = [counts.without_end for counts in self.by_camera.values()]
        unsent, copies = (sum(abs(found[i]) for found in per_camera) for i in (0, 1))
        found = {
            "captured = replaced + waiting + sent is off by {:,} frames": unsent,
            "sent + duplicated = the sum of all ends is off by {:,} copies": copies,
            "the ledgers contradict each other on {:,} frames": self.contradiction_count,
            "{:,} lines of the ledgers were lost": self.lines_lost,
            f"ledgers that cannot be read ({', '.join(self.unreadable)}): {{}}": len(self.unreadable),
        }
        return [text.format(count) for text, count in found.items() if count]

    def as_dict(self) -> dict[str, Any]:
        """The ``frames`` part of a report."""
        reasons = dict(sorted(self.unknown_origin.items()))
        return {
            **self.total.as_dict(),
            "closes": not self.doubts,
            "doubts": self.doubts,
            "lines_lost": self.lines_lost,
            "contradictions": self.contradictions,
            "contradiction_count": self.contradiction_count,
            "strangers": {"count": self.unknown_origin.total(), "reasons": reasons},
            "by_camera": {camera: counts.as_dict() for camera, counts in sorted(self.by_camera.items())},
        }

    def add(self, camera: str, counts: FrameCounts, times: int = 1) -> None:
        """Add ``counts`` to a camera and to the total, ``times`` times."""
        self.by_camera.setdefault(camera, FrameCounts()).add(counts, times)
        self.total.add(counts, times)

    def contradict(self, frame: str, found: Sequence[str]) -> None:
        """Record contradictory statements about a frame."""
        self.contradiction_count += len(found)
        self.contradictions += [f"{frame}: {what}" for what in found[: MOST_CONTRADICTIONS - len(self.contradictions)]]


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
        return _History(
            **counts, incomplete=self.incomplete | (set() if complete else {role}), last_file=last[0], last_role=last[1]
        )


class _Histories:
    """Every different history, by number; 0 is the empty one. A hundred thousand frames share a few dozen, so
    a frame costs one number and each transition is computed once."""

    def __init__(self) -> None:
        self.all = [_History()]
        self._transitions: dict[tuple[int, int, str], int] = {}

    def after(self, number: int, role: str, event: str, file: int, complete: bool) -> int:
        """The number of history ``number`` with one more event."""
        transition = (number, file, event)
        result = self._transitions.get(transition)
        if result is None:
            result = self._transitions[transition] = len(self.all)
            self.all.append(self.all[number].after(role, event, file, complete))
        return result


@dataclass
class _LedgerContents:
    """The contents of all ledgers.

    frames: number of each frame's history, by (camera, session) and sequence. accepted: cameras about which
    some process wrote more than refusals. unknown_events: how often each event that no role writes was read.
    near_end: frames written about near the end of a ledger without ``closed``; bit r: of one of role r.
    """

    histories: _Histories = field(default_factory=_Histories)
    frames: dict[tuple[str, str], dict[int, int]] = field(default_factory=dict)
    accepted: set[str] = field(default_factory=set)
    unknown_events: Counter[str] = field(default_factory=Counter)
    near_end: dict[tuple[str, str, int], int] = field(default_factory=dict)


def account_frames(out: Path) -> FrameAccounting:
    """Join every ledger in the folder ``out``. Ledgers that cannot be read are left out and noted."""
    accounting = FrameAccounting()
    ledgers, notes = [], accounting.notes
    for path in sorted(out.glob("ledger-*.tsv")):
        try:
            ledgers.append(LedgerReader(path))
        except (ValueError, OSError) as error:
            notes.append(f"{path.name} left out: {error}")
            if not _without_a_line(path):
                accounting.unreadable.append(path.name)
    accounting.ledgers = len(ledgers)
    contents = _LedgerContents()
    ends = _cut_off_ends(ledgers)
    for number, ledger in enumerate(ledgers):
        _read_ledger(contents, number, ledger, ends, accounting)
    unknown = sorted(contents.unknown_events.items())
    notes += [f"{count} lines with an unknown {event} left out" for event, count in unknown]

    has_node_ledger = any(ledger.role == "node" for ledger in ledgers)
    evaluated = [_evaluate(history) for history in contents.histories.all]
    open_at: dict[str, Counter[int]] = {"in_flight": Counter(), "cut_off": Counter()}
    without_node = 0
    for (camera, session), frames in sorted(contents.frames.items()):
        node_wrote = any(contents.histories.all[number].node for number in set(frames.values()))
        for number, count in Counter(frames.values()).items():
            history, (counts, contradictions) = contents.histories.all[number], evaluated[number]
            refusals = _refusals(history)
            only_refused = node_wrote and refusals.total() == history.emulator.total() + history.edge.total()
            if not history.node and (only_refused or (has_node_ledger and camera not in contents.accepted)):
                for reason, copies in refusals.items():
                    accounting.unknown_origin[reason] += copies * count
                continue
            accounting.add(camera, counts, count)
            if not history.node:
                without_node += count
                if node_wrote:
                    contradictions = [*contradictions, "arrived, but its node wrote nothing about it"]
            open_at["in_flight"][history.last_file] += counts["in_flight"] * count
            unsent, copies = counts.without_end
            if not contradictions and unsent <= 0 and copies <= 0:
                continue
            newest = max(frames)
            for sequence in sorted(s for s, other in frames.items() if other == number):
                near, said = contents.near_end.get((camera, session, sequence), 0), contradictions
                if unsent > 0 and sequence == newest and near & 1 and not history.last_role:
                    accounting.add(camera, FrameCounts(waiting=unsent))
                elif copies > 0 and near >> history.last_role:
                    accounting.add(camera, FrameCounts(cut_off=copies))
                    open_at["cut_off"][history.last_file] += copies
                elif unsent > 0 or copies > 0:
                    what = f"the end of {copies} sent copies" if copies > 0 else "what became of the capture"
                    said = [*contradictions, f"{what} is in no ledger"]
                accounting.contradict(f"{camera} {session} {sequence}", said)
    if ledgers and not any(ledger.role == "edge" for ledger in ledgers):
        notes.append("no edge's ledger here: what the edge took has no end")
    if without_node:
        notes.append(f"{without_node} frames have no node's ledger here: counted as captured and sent")
    if accounting.unknown_origin:
        count = accounting.unknown_origin.total()
        notes.append(f"{count} frames of unknown origin were refused: counted apart")
    for what, at in open_at.items():
        for number, copies in sorted(at.items()):
            if copies:
                state = what.replace("_", " ")
                notes.append(f"{copies} {state}, last written by {ledgers[number].path.name}")
    return accounting


def _without_a_line(path: Path) -> bool:
    """Whether the first line is incomplete: its process was killed before it wrote about any frame."""
    try:
        with path.open("rb") as file:
            return not file.readline(1 << 16).endswith(b"\n")
    except OSError:
        return False


def _cut_off_ends(ledgers: Sequence[LedgerReader]) -> list[tuple[int, list[Event]]]:
    """(number of the role, last events) of each ledger without ``closed``."""
    ends = []
    for ledger in ledgers:
        try:
            tail = ledger.tail()
        except OSError:
            continue
        if tail and tail[-1].event != "closed" and ledger.role in _ROLES:
            ends.append((_ROLES.index(ledger.role), tail))
    return ends


def _last_moments(ledger: LedgerReader, ends: Sequence[tuple[int, list[Event]]]) -> list[tuple[int, int, int]]:
    """(number of the role, first and last instant) of the last moments of each of ``ends``, on the clock of ``ledger``:
    the frames about which both wrote give the offset between the clocks of two machines."""
    wrote: dict[tuple[str, str, int], list[tuple[int, int]]] = {}
    for number, (_, tail) in enumerate(ends):
        for e in tail:
            wrote.setdefault((e.camera, e.session, e.sequence), []).append((number, e.t_ns))
    apart: list[list[int]] = [[] for _ in ends]
    for e in ledger if ends else ():
        for number, t_ns in wrote.get((e.camera, e.session, e.sequence), ()):
            apart[number].append(e.t_ns - t_ns)
    last_ns = [tail[-1].t_ns + (int(median(found)) if found else 0) for (_, tail), found in zip(ends, apart)]
    return [(role, at_ns - CUT_OFF_NS, at_ns + CUT_OFF_NS) for (role, _), at_ns in zip(ends, last_ns)]


def _read_ledger(
    contents: _LedgerContents,
    number: int,
    ledger: LedgerReader,
    ends: Sequence[tuple[int, list[Event]]],
    accounting: FrameAccounting,
) -> None:
    """Read ledger ``number`` into ``contents``, and what is missing into ``accounting``. ends: from
    ``_cut_off_ends``."""
    role, name, notes = ledger.role, ledger.path.name, accounting.notes
    known = _EVENTS.get(role, set())
    after, lost, lost_at_end = contents.histories.after, 0, 0
    try:
        complete, closed, moments = ledger.complete, ledger.closed, _last_moments(ledger, ends)
        for e in ledger:
            event = e.event
            if event in known:
                if event == "answered":
                    event = f"answered:{e.detail.lower().replace('-', '_')}"
                elif event == "rejected":
                    reason = e.detail or "unknown"
                    if _GARBLED in (e.camera, e.session):
                        accounting.unknown_origin[reason] += 1
                        continue
                    event = f"rejected:{reason}"
                if e.event != "rejected":
                    contents.accepted.add(e.camera)
                frames = contents.frames.setdefault((e.camera, e.session), {})
                frames[e.sequence] = after(frames.get(e.sequence, 0), role, event, number, complete)
                for ended, first_ns, last_ns in moments:
                    if first_ns <= e.t_ns <= last_ns:
                        frame = (e.camera, e.session, e.sequence)
                        contents.near_end[frame] = contents.near_end.get(frame, 0) | 1 << ended
            elif event == "lost_lines":
                lost += int(e.detail) if e.detail.isdecimal() else 1
            elif event == "closed":
                lost_at_end = int(e.detail) if e.detail.isdecimal() else 0
            else:
                contents.unknown_events[f"{role} event {event!r}"] += 1
    except OSError as error:
        notes.append(f"{name}: read in part: {error}")
        accounting.unreadable.append(name)
        return
    if ledger.torn:
        notes.append(f"{name}: unreadable line left out (killed while writing, or a full disk)")
    # A partly written line counts as lost by its writer and as torn by its reader. One cut off by a kill is not lost.
    lost = max(lost, lost_at_end, ledger.torn - (ledger.unfinished and not closed))
    accounting.lines_lost += lost
    if lost:
        notes.append(f"{name}: {lost} lines were lost while it could not be written (a full disk?)")
    if not closed:
        notes.append(f"{name}: not closed (killed, or still running)")


def _refusals(history: _History) -> Counter[str]:
    """How often emulator and edge rejected copies of the frame, by reason."""
    refusals: Counter[str] = Counter()
    for event, count in [*history.emulator.items(), *history.edge.items()]:
        name, _, reason = event.partition(":")
        if name == "rejected":
            refusals[reason] += count
    return refusals


def _evaluate(history: _History) -> tuple[FrameCounts, list[str]]:
    """The counts of one frame by what was written, and what cannot be true about it."""
    counts = FrameCounts()
    node, emulator, edge = history.node, history.emulator, history.edge
    contradictions = _node_contradictions(history)
    answers = {e.partition(":")[2]: n for e, n in node.items() if e.startswith("answered:")}
    arrived, forwarded = edge.total(), emulator["forwarded"]
    if node:
        handed = node["sent"]
        counts.update({state: node[state] for state in ("captured", "replaced", "waiting")}, sent=min(1, handed))
    else:
        # No ledger here says how often it was sent: each arrival at the first known hop counts as one.
        handed = emulator["received"] or (1 if emulator else arrived)
        counts.update(captured=handed, sent=handed)
    counts["duplicated"] = handed - counts["sent"] + emulator["duplicated"]
    copies = handed + emulator["duplicated"]
    if arrived > copies:
        contradictions.append(f"reached the edge {arrived} times but only {copies} copies were made")
    if emulator and arrived > forwarded and "emulator" not in history.incomplete:
        contradictions.append(f"reached the edge {arrived} times but was forwarded {forwarded} times")
    if emulator["received"] > handed:
        contradictions.append(f"received {emulator['received']} times but sent {handed} times")
    ends = {e: n for e, n in emulator.items() if _is_end(e)}
    if forwarded + sum(ends.values()) > copies:
        contradictions.append(f"{copies} copies, but {forwarded} forwarded and {sum(ends.values())} ended before")
    counts.add(edge)
    counts.add(ends)
    for answer, count in answers.items():
        if _is_end(answer):
            counts[answer if answer != "rejected" else "rejected:unknown"] += min(count, max(0, counts.without_end[1]))
    counts["broken"] += min(emulator["broken"] or node["broken"], max(0, counts.without_end[1]))
    if (excess := -counts.without_end[1]) > 0 and not contradictions:
        contradictions.append(f"{excess} ends more than copies")
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
