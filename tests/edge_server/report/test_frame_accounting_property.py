"""Random deployments with random kills: the counts close, and equal what really happened."""

from __future__ import annotations

import tempfile
from collections import Counter
from pathlib import Path

from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.report.frame_accounting import ENDS, LINK_ENDS, account_frames
from tests.edge_server.report.ledgers import write

EVENTS = {
    "node": ["captured", "replaced", "waiting", "sent", "broken", "answered"],
    "emulator": [
        "received",
        "skipped",
        "dropped_busy",
        "superseded",
        "lost",
        "rejected",
        "forwarded",
        "duplicated",
        "broken",
        "in_flight",
    ],
    "edge": ["delivered", "rejected"],
}


# What really becomes of one frame.
FATES = st.sampled_from(
    [
        "waiting",
        "replaced",
        "sent",
        "received",
        "skipped",
        "dropped_busy",
        "superseded",
        "lost",
        "forwarded",
        "delivered",
        "rejected",
        "doubled",
    ]
)


def ledger_lines(fate):
    """The lines (role, event, detail) that processes write about a frame with this fate, in order of time,
    where all of them end in order."""
    node = [("node", "captured", "")]
    if fate in ("waiting", "replaced"):
        return [*node, ("node", fate, "")]
    lines = [*node, ("node", "sent", "")]
    if fate == "sent":
        return [*lines, ("node", "broken", "")]
    lines.append(("emulator", "received", ""))
    if fate == "received":
        return [*lines, ("emulator", "in_flight", "")]
    if fate in LINK_ENDS:
        return [*lines, ("emulator", fate, "")]
    if fate == "doubled":
        lines.append(("emulator", "duplicated", ""))
    lines.append(("emulator", "forwarded", ""))
    if fate == "forwarded":
        return [*lines, ("emulator", "broken", "")]
    lines.append(("edge", "rejected", "crc") if fate == "rejected" else ("edge", "delivered", ""))
    if fate == "doubled":
        lines += [("emulator", "forwarded", ""), ("edge", "rejected", "replayed_sequence")]
    return lines


@settings(max_examples=200, deadline=None)
@given(st.lists(FATES, max_size=30), st.data())
def test_counts_are_true_even_if_every_process_is_killed(fates, data):
    """All processes die at a random instant. No kill makes a contradiction, and each frame's state is the
    last event that was written about it."""
    written = [(i, *line) for i, fate in enumerate(fates) for line in ledger_lines(fate)]
    alive = data.draw(st.integers(0, len(written)))
    # A kill may tear the last line of all: no process acts on what it has not written.
    torn_role = written[alive - 1][1] if 0 < alive < len(written) and data.draw(st.booleans()) else None
    with tempfile.TemporaryDirectory() as folder:
        kept = []
        for role in EVENTS:
            lines = [line for line in written[:alive] if line[1] == role]
            torn = lines[-1:] if role == torn_role else []
            lines = lines[: len(lines) - len(torn)]
            path = write(Path(folder), role, [(i, e, d) for i, _, e, d in lines], closed=alive == len(written))
            if torn:
                with path.open("ab") as file:
                    file.write(b"99\ta\ts\t" + str(torn[0][0]).encode())
            kept += lines
        accounting = account_frames(Path(folder))
    found = accounting.as_dict()
    assert found["closes"]
    truth = Counter()
    for i in {line[0] for line in kept}:
        wrote = [(role, event) for n, role, event, _ in kept if n == i]
        beyond = [event for role, event in wrote if role != "node"]
        if not beyond and ("node", "sent") not in wrote:
            truth["replaced" if ("node", "replaced") in wrote else "waiting"] += 1
            continue
        ends = [e for e in beyond if e in (*LINK_ENDS, "delivered", "rejected")]
        copies = max(1 + beyond.count("duplicated"), len(ends))
        truth["sent"] += 1
        truth["duplicated"] += copies - 1
        for end in ends:
            truth[end] += 1
        broken = (wrote[-1][1] == "broken") * (copies - len(ends))
        truth["broken"] += broken
        truth["cut_off"] += copies - len(ends) - broken
    flat = {**found, "rejected": sum(found["rejected"].values())}
    for name in ("waiting", "replaced", "sent", "duplicated", *ENDS):
        assert flat[name] == truth[name], name
    assert accounting.contradictions == []
