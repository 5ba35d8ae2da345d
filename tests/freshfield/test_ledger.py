"""The ledger: what was written is read, whatever killed the writer; files are whole whenever somebody looks, and a full
disk costs lines, not processes."""

import argparse
import json
import os
import resource
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest
from hypothesis import given
from hypothesis import strategies as st

from freshfield.files import Lines, out_file, out_folder, write_json
from freshfield.ledger import Event, Ledger, LedgerReader, read_all
from tests.support import refused


def write(out, events, closed=True):
    ledger = Ledger(out, "node", "cam00", 7)
    for e in events:
        ledger.write(e.t_ns, e.camera, e.session, e.sequence, e.event, e.detail)
    if closed:
        ledger.close(99)
    return ledger.path


EVENTS = [Event(1, "cam00", "s", 0, "captured"), Event(2, "cam00", "s", 0, "answered", "rejected:crc_mismatch")]


@given(cut=st.integers(0, 200))
def test_a_file_cut_anywhere_loses_at_most_its_last_line(tmp_path_factory, cut):
    path = write(tmp_path_factory.mktemp("ledger"), EVENTS * 2, closed=False)
    data = path.read_bytes()
    head = data.index(b"\n") + 1
    cut = head + cut % (len(data) - head + 1)
    path.write_bytes(data[:cut])
    file = LedgerReader(path)
    assert file.events == tuple((EVENTS * 2)[: data[head:cut].count(b"\n")])
    assert file.torn == (not data[:cut].endswith(b"\n")) and not file.closed


def test_damaged_lines_are_left_out_and_other_files_refused(tmp_path):
    path = write(tmp_path, EVENTS)
    path.write_bytes(path.read_bytes().replace(b"\tanswered\t", b"\0\xff"))
    file = LedgerReader(path)
    assert file.events == (EVENTS[0], Event(99, "", "", 0, "closed")) and file.torn and file.closed
    assert (path.name, file.role, file.name) == ("ledger-node-cam00-7.tsv", "node", "cam00") and not file.unfinished
    for data in (b"", b"hello\n", b"#freshfield-ledger 2 node cam00 1\n", b"\xff\xfe"):
        path.write_bytes(data)
        refused(ValueError, "not a freshfield ledger", LedgerReader, path)


def test_threads_do_not_tear_each_others_lines(tmp_path):
    ledger = Ledger(tmp_path, "emulator", "e", 1)

    def work(camera):
        for k in range(500):
            ledger.write(k, camera, "s" * 40, k, "forwarded", "d" * 40)

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, (f"cam{i}" for i in range(4))))
    ledger.close(0)
    ledger.write(1, "late", "s", 1, "forwarded")  # after the end: ignored
    file = LedgerReader(ledger.path)
    assert len(file.events) == 2001 and not file.torn and file.closed


def test_what_was_written_survives_sigkill(tmp_path):
    program = (
        "import sys; from pathlib import Path; from freshfield.ledger import Ledger\n"
        "ledger, k = Ledger(Path(sys.argv[1]), 'edge', 'e', 1), 0\n"
        "while True:\n    ledger.write(k, 'cam00', 's', k, 'delivered'); k += 1\n    print(k, flush=True)\n"
    )
    with subprocess.Popen([sys.executable, "-c", program, str(tmp_path)], stdout=subprocess.PIPE) as child:
        seen = [child.stdout.readline() for _ in range(20)]
        child.send_signal(signal.SIGKILL)
        promised = int([*seen, *child.stdout.read().splitlines()][-1])
    (file,) = read_all(tmp_path)
    assert not file.closed and len(file.events) >= promised > 10
    assert [e.sequence for e in file.events] == list(range(len(file.events)))


def test_the_reader_finds_the_end_without_reading_the_whole(tmp_path):
    path = write(tmp_path, EVENTS * 3000)
    assert path.stat().st_size > 2 * 65536
    reader = LedgerReader(path)
    assert reader.last() == Event(99, "", "", 0, "closed") and reader.complete
    assert sum(1 for _ in reader) == 6001 == sum(1 for _ in reader)
    path.write_bytes(path.read_bytes()[:-3])
    assert LedgerReader(path).last() == EVENTS[1] and not LedgerReader(path).closed
    longest = [Event(k, "cam00", "s", k, "answered", "x" * 40_000) for k in range(3)]
    (longer := tmp_path / "longer").mkdir()  # than what is read at the end
    assert LedgerReader(write(longer, longest, closed=False)).last() == longest[-1]


def test_a_full_disk_costs_lines_and_the_ledger_says_how_many(tmp_path):
    ledger = Ledger(tmp_path, "node", "cam00", 7)
    lost = []
    for k in range(3):
        size = ledger.path.stat().st_size
        with no_file_longer_than(size + 10 * k):
            for _ in range(k + 1):
                ledger.write(k, "cam00", "s", k, "captured")
        ledger.write(k, "cam00", "s", k, "captured")
        lost.append(ledger.lines_lost)
    ledger.close(9)
    file = LedgerReader(ledger.path)
    said = [int(e.detail) for e in file.events if e.event == "lost_lines"]
    assert lost == [1, 3, 6] and said == [1, 2, 3]
    assert [e.sequence for e in file.events if e.event == "captured"] == [0, 1, 2]
    assert file.events[-1].detail == "6" and file.closed and not file.complete


@contextmanager
def no_file_longer_than(size: int):
    """A real limit: the kernel takes a part of the write that crosses it and refuses those after."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_json_is_replaced_whole_by_any_number_of_threads(tmp_path):
    path = tmp_path / "status.json"

    def write(who: int) -> None:
        for _ in range(100):
            write_json(path, {"who": who, "filling": [who] * 2000})

    write(-1)
    with ThreadPoolExecutor(4) as pool:
        writers = [pool.submit(write, who) for who in range(4)]
        while not all(writer.done() for writer in writers):
            json.loads(path.read_text())
    assert [writer.exception() for writer in writers] == [None] * 4 and os.listdir(tmp_path) == ["status.json"]


def test_a_place_that_cannot_be_written_is_refused_with_its_option(tmp_path, capsys, monkeypatch):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    monkeypatch.setattr(os, "access", lambda path, _: path.name != "folder")
    for option, place, said in (
        (out_folder, "file/x", "file is a file, not a folder: name another"),
        (out_file, "folder", "folder is a folder, not a file: name another"),
        (out_folder, "folder/new/x", "folder cannot be written to: name another place"),
        (out_folder, "a\udcff", r"a\udcff' is not UTF-8: name another"),
    ):
        parser = argparse.ArgumentParser()
        parser.add_argument("--out", type=option)
        refused(SystemExit, "2", parser.parse_args, ["--out", str(tmp_path / place)])
        told = capsys.readouterr().err
        assert "argument --out: " in told and f"{tmp_path}/{said}" in told


def test_a_write_that_fails_leaves_the_old_file_and_nothing_beside_it(tmp_path):
    path = tmp_path / "status.json"
    write_json(path, {"a": 1})
    with no_file_longer_than(10), pytest.raises(OSError):
        write_json(path, {"a": "x" * 1000})
    refused(ValueError, "", write_json, path, {"a": float("nan")})
    assert json.loads(path.read_text()) == {"a": 1} and os.listdir(tmp_path) == ["status.json"]


def test_half_a_line_of_a_killed_writer_is_a_line_of_its_own(tmp_path, monkeypatch):
    (tmp_path / "rows.jsonl").write_text('{"a": 1}\n{"a": ')
    lines = Lines(tmp_path / "rows.jsonl")
    assert lines.write('{"a": 2}') and not lines.lost
    monkeypatch.setattr("os.write", lambda fd, data: len(data) * lines._lock.locked())
    assert lines.write(""), "another thread may close the file meanwhile"
    lines.close()
    assert not lines.write("late")
    whole, half, new = (tmp_path / "rows.jsonl").read_text().splitlines()
    assert (whole, new) == ('{"a": 1}', '{"a": 2}')
    refused(ValueError, "", json.loads, half)
