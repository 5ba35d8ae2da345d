import tempfile
import tracemalloc
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.report.frame_accounting import ENDS, LINK_ENDS, account_frames
from tests.edge_server.report.sample_run import write


def sent(*sequences):
    return [(i, event) for i in sequences for event in ("captured", "sent")]


def told(text):
    """Lines of a ledger: NUMBER:EVENT or NUMBER:EVENT:DETAIL each."""
    return [(int(number), *rest) for number, *rest in (word.split(":") for word in text.split())]


def counts(out, **expected):
    """Join the ledgers under ``out``; every count not in ``expected`` must be zero."""
    accounting = account_frames(out)
    found = accounting.as_dict()
    assert found["closes"], found
    flat = {k: v for k, v in found.items() if isinstance(v, int) and not isinstance(v, bool) and v}
    if found["rejected"]:
        flat["rejected"] = found["rejected"]
    assert flat == expected
    return accounting


# name -> (lines of node, emulator and edge; every count that is not zero; part of a note, or none)
RUNS = {
    "a node whose ledger is elsewhere": (
        None,
        [*told("0:received 0:forwarded 1:received 1:lost")],
        [(0, "delivered")],
        {"captured": 2, "sent": 2, "delivered": 1, "lost": 1},
        "no node's ledger",
    ),
    "a delivery at the edge outranks a broken stream": (
        [*sent(0, 1), (0, "broken"), (1, "broken")],
        [(0, "received"), (0, "forwarded"), (0, "broken")],
        [(0, "delivered")],
        {"captured": 2, "sent": 2, "delivered": 1, "broken": 1},
        "",
    ),
    "an answer, where the emulator's ledger is elsewhere": (
        [*sent(0, 1, 2), (0, "answered", "dropped-busy"), (1, "answered", "rejected:crc"), (2, "answered", "accepted")],
        None,
        [(2, "delivered")],
        {"captured": 3, "sent": 3, "dropped_busy": 1, "delivered": 1, "rejected": {"crc": 1}},
        "",
    ),
    "an unknown event": (
        [*sent(0, 1), (0, "teleported")],
        told("0:received 0:rejected:crc 1:received 1:in_flight"),
        None,
        {"captured": 2, "sent": 2, "in_flight": 1, "rejected": {"crc": 1}},
        "teleported",
    ),
}


@pytest.mark.parametrize("name", RUNS)
def test_every_frame_is_counted_by_what_was_written(tmp_path, name):
    *ledgers, expected, note = RUNS[name]
    for role, lines in zip(("node", "emulator", "edge"), ledgers):
        if lines is not None:
            write(tmp_path, role, lines)
    accounting = counts(tmp_path, **expected)
    assert not note or any(note in line for line in accounting.notes)
    assert accounting.ledgers == sum(lines is not None for lines in ledgers)


HELD = {
    "node": [*sent(0), (1, "captured"), (1, "waiting")],
    "emulator": [(0, "received"), (0, "duplicated"), (0, "forwarded"), (0, "in_flight")],
    "edge": [(0, "delivered")],
}


def test_no_term_is_a_remainder(tmp_path):
    """Without any one line the account does not close, and says why."""
    frames_off = [("node", (1, "waiting")), ("node", (0, "captured"))]
    copies_off = [("emulator", (0, "in_flight")), ("emulator", (0, "duplicated")), ("edge", (0, "delivered"))]
    for number, left_out in enumerate([None, *frames_off, *copies_off]):
        folder = tmp_path / str(number)
        for written, lines in HELD.items():
            write(folder, written, [line for line in lines if (written, line) != left_out])
        found = account_frames(folder).as_dict()
        assert found["closes"] == (left_out is None)
        off = "off by 1 frames" if left_out in frames_off else "off by 1 copies"
        assert left_out is None or any(doubt.endswith(off) for doubt in found["doubts"])


def test_killed_processes_and_torn_lines(tmp_path):
    node = write(tmp_path, "node", [*sent(0, 1, 2), (3, "captured")], closed=False)
    emulator = write(tmp_path, "emulator", [(0, "received"), (0, "forwarded"), (1, "received")], closed=False)
    # Killed in the middle of writing "4 captured" and "1 forwarded".
    with node.open("ab") as file:
        file.write(b"77\ta\ts\t4\tcapt")
    with emulator.open("ab") as file:
        file.write(b"78\ta\ts\t1\tforw")
    write(tmp_path, "edge", [(0, "delivered"), (1, "delivered")], closed=False)
    (tmp_path / "ledger-edge-x-9.tsv").write_bytes(b"#freshfield-le")  # before its first line was complete
    # Frame 1 reached the edge although nobody had time to write "forwarded": no contradiction.
    accounting = counts(tmp_path, captured=4, sent=3, waiting=1, delivered=2, cut_off=1)
    assert sum("unreadable line" in note for note in accounting.notes) == 2
    assert sum("not closed" in note for note in accounting.notes) == 3
    assert any(note.startswith("1 cut off, last written by ledger-node-") for note in accounting.notes)
    assert any("ledger-edge-x-9.tsv left out" in note for note in accounting.notes)
    (tmp_path / "ledger-edge-x-9.tsv").write_bytes(b"#another-ledger\n1\ta\ts\t0\tdelivered\t\n")
    assert account_frames(tmp_path).doubts == ["ledgers that cannot be read (ledger-edge-x-9.tsv): 1"]


# What is said of one frame -> the events that node, emulator and edge wrote of it, and what is counted.
CONTRADICTIONS = {
    "1 times but was forwarded 0": ("captured sent", "received dropped_busy", "delivered", "delivered dropped_busy"),
    "reached the edge 2 times but only 1": ("captured sent", "received forwarded", *["delivered delivered"] * 2),
    "replaced at the node, yet sent": ("captured replaced", "received lost", "", "lost"),
    "never wrote that it was sent": ("captured", "", "delivered", "delivered"),
    "1 copies, but 0 forwarded and 2": ("captured sent", "received lost skipped", "", "lost skipped"),
    "1 forwarded and 1 ended before": ("captured sent", "received lost forwarded", "", "lost"),
    "received 2 times but sent 1 times": ("captured sent", "received received lost", "", "lost"),
    "wrote captured 0 times": ("sent", "", "delivered", "delivered"),
    "arrived, but its node wrote nothing about it": ("", "", "delivered", "delivered"),
}


@pytest.mark.parametrize("message", CONTRADICTIONS)
def test_contradictions_are_listed_and_every_end_counts_as_written(tmp_path, message):
    *written, counted = (text.split() for text in CONTRADICTIONS[message])
    write(tmp_path, "node", [(1, event) for event in ("captured", "replaced")])
    for number, (role, events) in enumerate(zip(("node", "emulator", "edge"), written)):
        if events or role != "emulator":
            write(tmp_path, role, [(0, event) for event in events], start_ns=2 + number)
    accounting = account_frames(tmp_path)
    listed = accounting.contradictions
    assert any(message in line and line.startswith("a s 0: ") for line in listed), listed
    found = accounting.as_dict()
    assert not found["closes"] and found["doubts"]
    ends = ("delivered", "dropped_busy", "lost", "skipped", "in_flight", "duplicated")
    assert {k: found[k] for k in ends if found[k]} == Counter(counted)


def test_an_old_frame_without_an_end_is_no_excuse_of_a_kill(tmp_path):
    """A killed process explains what it held in its last seconds, not what was lost a minute before."""
    write(tmp_path, "node", sent(0, 1))
    path = write(tmp_path, "emulator", [], closed=False)
    with path.open("a") as file:
        file.write(f"0\ta\ts\t0\treceived\t\n{60 * 10**9}\ta\ts\t1\treceived\t\n")
    found = account_frames(tmp_path)
    assert found.total["cut_off"] == 1 and found.total.without_end == (0, 1)
    assert found.contradictions == ["a s 0: the end of 1 sent copies is in no ledger"]


def test_clocks_of_two_machines_far_apart_leave_cut_off_what_a_kill_cut_off(tmp_path):
    write(tmp_path, "node", sent(0, 1))
    write(tmp_path, "emulator", told("0:received 0:forwarded 1:received 1:forwarded"))
    with write(tmp_path, "edge", [], closed=False).open("a") as file:
        file.write(f"{3600 * 10**9}\ta\ts\t0\tdelivered\t\n")
    counts(tmp_path, captured=2, sent=2, delivered=1, cut_off=1)


def test_frames_of_unknown_origin_are_counted_apart(tmp_path):
    write(tmp_path, "node", HELD["node"])
    write(tmp_path, "emulator", [("intruder", "x", 0, "rejected", "unknown_camera")])
    edge = [("?", "?", 0, "rejected", "bad_id")] * 3
    edge += [("a", "?", 7, "rejected", "bad_id"), ("mars", "s", 1, "rejected", "unknown_camera")]
    # Camera b's node wrote its ledger elsewhere: the edge took its frames, so b is a known camera.
    edge += [(0, "delivered"), ("b", "s", 0, "delivered"), ("b", "s", 1, "rejected", "too_old")]
    write(tmp_path, "edge", edge)
    accounting = counts(tmp_path, captured=4, sent=3, waiting=1, delivered=2, rejected={"too_old": 1})
    found = accounting.as_dict()
    assert found["strangers"] == {"count": 6, "reasons": {"bad_id": 4, "unknown_camera": 2}}
    assert set(found["by_camera"]) == {"a", "b"}
    for name in ("captured", "sent", "waiting", "delivered"):
        assert found[name] == sum(camera[name] for camera in found["by_camera"].values())
    assert any("6 frames of unknown origin" in note for note in accounting.notes)


def test_a_frame_refused_thousands_of_times_takes_little_memory(tmp_path):
    write(tmp_path, "edge", [("a", "s", 0, "rejected", "too_old")] * 3000)
    tracemalloc.start()
    assert account_frames(tmp_path).total["rejected:too_old"] == 3000
    assert tracemalloc.get_traced_memory()[1] < 2e7
    tracemalloc.stop()


def test_lines_lost_to_a_full_disk_are_no_contradiction_and_do_not_close(tmp_path):
    write(tmp_path, "node", sent(0))
    path = write(tmp_path, "emulator", [(0, "received")], closed=False)
    with path.open("a") as file:
        file.write("5\t\t\t0\tlost_lines\t2014\n6\t\t\t0\tclosed\t2014\n")
    write(tmp_path, "edge", [(0, "delivered")])
    accounting = account_frames(tmp_path)
    assert accounting.contradictions == [] and accounting.total.without_end == (0, 0)
    assert accounting.doubts == ["2,014 lines of the ledgers were lost"]
    assert any("2014 lines were lost" in note for note in accounting.notes)
    assert not accounting.as_dict()["closes"]


ON_LINK = "node:captured node:sent emulator:received"
# What really becomes of one frame: the lines that processes write about it, in order of time, where all end in order.
LIVES = {end: f"{ON_LINK} emulator:{end}" for end in LINK_ENDS} | {
    "waiting": "node:captured node:waiting",
    "replaced": "node:captured node:replaced",
    "sent": "node:captured node:sent node:broken",
    "received": f"{ON_LINK} emulator:in_flight",
    "forwarded": f"{ON_LINK} emulator:forwarded emulator:broken",
    "delivered": f"{ON_LINK} emulator:forwarded edge:delivered",
    "rejected": f"{ON_LINK} emulator:forwarded edge:rejected:crc",
    "doubled": f"{ON_LINK} emulator:duplicated emulator:forwarded edge:delivered emulator:forwarded"
    " edge:rejected:replayed_sequence",
}


@settings(max_examples=200, deadline=None)
@given(st.lists(st.sampled_from(sorted(LIVES)), max_size=30), st.data())
def test_counts_are_true_even_if_every_process_is_killed(fates, data):
    """All processes die at a random instant. No kill makes a contradiction, and each frame's state is the
    last event that was written about it."""
    written = [(i, *line.split(":")) for i, fate in enumerate(fates) for line in LIVES[fate].split()]
    alive = data.draw(st.integers(0, len(written)))
    # A kill may tear the last line of all: no process acts on what it has not written.
    torn_role = written[alive - 1][1] if 0 < alive < len(written) and data.draw(st.booleans()) else None
    with tempfile.TemporaryDirectory() as folder:
        kept = []
        for role in ("node", "emulator", "edge"):
            lines = [line for line in written[:alive] if line[1] == role]
            torn = lines[-1:] if role == torn_role else []
            lines = lines[: len(lines) - len(torn)]
            # A restarted node is a new session, which counts from zero again.
            told = [("a", f"s{i % 2}", i // 2, *rest) for i, _, *rest in lines]
            path = write(Path(folder), role, told, closed=alive == len(written))
            if torn:
                with path.open("ab") as file:
                    file.write(b"99\ta\ts\t" + str(torn[0][0]).encode())
            kept += lines
        accounting = account_frames(Path(folder))
    found = accounting.as_dict()
    assert found["closes"]
    truth = Counter()
    for i in {line[0] for line in kept}:
        wrote = [(role, event) for n, role, event, *_ in kept if n == i]
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
