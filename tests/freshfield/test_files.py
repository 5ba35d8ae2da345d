"""Files are whole whenever somebody looks, and a full disk costs lines, not processes."""

import argparse
import json
import logging
import os
import resource
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import pytest

from freshfield.files import Lines, out_file, out_folder, write_json
from tests.support import refused


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


def test_lines_that_do_not_fit_are_counted_and_said_once(tmp_path, caplog):
    (tmp_path / "rows.jsonl").write_text('{"a": 1}\n{"a": ')  # half a line of a killed writer
    size = (tmp_path / "rows.jsonl").stat().st_size
    lines = Lines(tmp_path / "rows.jsonl")
    row = json.dumps({"row": "x" * 20})
    with caplog.at_level(logging.WARNING), no_file_longer_than(size + 81):
        written = [lines.write(row) for _ in range(6)]
    assert written == [True, True, False, False, False, False] and lines.lost == 4
    assert len(caplog.records) == 1 and "rows.jsonl" in caplog.text
    assert lines.write(row) and lines.lost == 4
    lines.close()
    assert not lines.write(row)
    found = (tmp_path / "rows.jsonl").read_text().splitlines()[2:]
    # The half line is a line of its own, and no JSON.
    assert [line == row for line in found] == [True, True, False, True]
    refused(ValueError, "", json.loads, found[2])
