"""The recorder: callers never wait, what finds no room is counted, a full disk ends the recording."""

from __future__ import annotations

import threading

import pytest

from edge_server.live.output.recorder import Recorder
from edge_server.live.state import Publication
from freshfield.v1 import frames_pb2 as pb
from tests.freshfield.test_session import requests

pytest.importorskip("mcap", reason="MCAP is not installed (extra mcap)")


from freshfield.session.reader import Session

PUBLICATION = Publication(3, 1.5, 10**9, None, ("cam01", "cam02"), (10.0, 20.0), 15.0, 5.0, 7, 0.25)


def test_what_finds_no_room_is_dropped_and_counted_and_nobody_waits(tmp_path, monkeypatch):
    monkeypatch.setattr("edge_server.live.output.recorder._MAX_QUEUE_MESSAGES", 10)
    recorder = Recorder(tmp_path / "a.mcap", "test")
    stuck, go_on = threading.Event(), threading.Event()
    write = recorder._writer.frame

    def slow_disk(request: pb.PushRequest, arrived_ns: int) -> None:
        stuck.set()
        assert go_on.wait(10)
        write(request, arrived_ns)

    recorder._writer.frame = slow_disk  # type: ignore[method-assign]
    sent = list(requests(20))
    recorder.frame(*sent[0])
    assert stuck.wait(10)
    for request, arrived_ns in sent[1:]:
        recorder.frame(request, arrived_ns)
    assert recorder.dropped == len(sent) - 1 - 10
    go_on.set()
    recorder.close()
    session = Session(tmp_path / "a.mcap")
    left = sorted((f.arrived_ns, session.payload(f)) for frames in session.frames.values() for f in frames)
    assert left == [(t, r.payload) for r, t in sent[:11]]


def test_a_full_disk_ends_the_recording_and_nothing_else(tmp_path, caplog):
    recorder = Recorder(tmp_path / "a.mcap", "test")

    def full(request: pb.PushRequest, arrived_ns: int) -> None:
        raise OSError(28, "No space left on device")

    recorder._writer.frame = full  # type: ignore[method-assign]
    sent = list(requests(3))
    for request, arrived_ns in sent:
        recorder.frame(request, arrived_ns)
    recorder.close()
    assert "recording ended: [Errno 28] No space left" in caplog.text
    assert recorder.status() == {"file": "a.mcap", "written": 0, "dropped": len(sent), "failed": True}
    recorder.published(PUBLICATION)
    assert recorder.dropped == len(sent) + 1


def test_a_server_that_starts_again_keeps_its_first_recording(tmp_path):
    files = []
    for _ in range(3):
        recorder = Recorder(tmp_path / "a.mcap", "test")
        recorder.close()
        files.append(recorder.file.name)
    assert files == ["a.mcap", "a-2.mcap", "a-3.mcap"]
