"""What strangers may send or write, each as a function of bytes that raises only what it documents.

Honest messages and files are made here, so that they stay honest; hostile ones, and whatever fuzzing once
found, lie in ``corpus/TARGET/``.
"""

import contextlib
import random
import tempfile
import time
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from camera_node.settings import source_config
from channel_emu.model.settings import channel_from_mapping
from edge_server.fields import checkpoint
from edge_server.live.buffer import FrameBuffer
from edge_server.live.ingest import Ingest
from edge_server.settings import read_config
from freshfield import payload, scenario
from freshfield.clock import VirtualClock
from freshfield.depth import DepthImage, EncodedDepth
from freshfield.frame import FrameRejected, checksum, parse, to_request
from freshfield.geometry import Pinhole
from freshfield.session import SessionError
from freshfield.v1 import frames_pb2 as pb
from tests.edge_server.frames import frame
from tests.support import work_ms

CORPUS = Path(__file__).parent / "corpus"
NOW = 10**18
CLOCK = VirtualClock(NOW)


@cache
def _ingest() -> Ingest:
    ledger = SimpleNamespace(write=lambda *line: "\t".join(map(str, line)))
    return Ingest(CLOCK, FrameBuffer(["cam01"]), ["cam00"], ledger, lambda frame: None)  # type: ignore[arg-type]


def request(_: Path, data: bytes) -> str:
    """A message at the edge, as it is and with a checksum that fits: ``from_request`` and all behind it."""
    plain = _ingest().take(data)
    with contextlib.suppress(FrameRejected):
        message = parse(data)
        message.crc32c = checksum(message)
        data = message.SerializeToString()
    CLOCK.advance_to(CLOCK.now_ns() + 10**6)
    mended = _ingest().take(data)
    return (plain.reason and mended.reason) or "accepted"


def pixels(_: Path, data: bytes) -> str:
    """``payload.check``, and ``decode`` of what passes. The first three bytes: codec, width, height."""
    codec, width, height = (data[:3] + b"\0\0\0")[:3]
    name = payload.CODECS[codec % 3]
    try:
        image = payload.decode(data[3:], name, width, height)
    except payload.PayloadError as error:
        return error.reason
    assert image.dtype == np.uint8 and image.shape[:2] == (height, width) and image.shape[2] in (3, 4)
    return name


def depths(_: Path, data: bytes) -> str:
    """``EncodedDepth.check``, and ``decode`` of what passes. The first two bytes: width and height."""
    width, height = (data[:2] + b"\0\0")[:2]
    depth = EncodedDepth(data[2:], width, height, 0.001)
    try:
        depth.check(Pinhole(width, height, 9.0, 9.0, 1.0, 1.0), 1)
        counts = depth.decode().counts
    except payload.PayloadError as error:
        return error.reason
    assert counts.dtype == np.uint16 and counts.shape == (height, width)
    return "depth"


def of_file(name: str, read: Callable[[Path], object], refusals: type[Exception]) -> Callable[[Path, bytes], str]:
    """A target that reads a file: what it refuses is one line of bounded length."""

    def take(folder: Path, data: bytes) -> str:
        (folder / name).write_bytes(data)
        try:
            read(folder / name)
            return "read"
        except refusals as error:
            assert len(str(error)) < 3000, f"an error of {len(str(error))} characters"
            return type(error).__name__

    return take


def scenarios(file: Path) -> None:
    """A scenario file, with the sections of all three packages."""
    found = scenario.load(file)
    source_config(found)
    channel_from_mapping(found.channel)
    read_config(found)


def mcap(file: Path) -> None:
    """A recorded session, of which every payload is read."""
    from freshfield.session.reader import Session

    with contextlib.closing(Session(file)) as session:
        for found in session.frames.values():
            for one in found:
                session.payload(one)
                session.depth(one)


PNG = payload.encode(np.zeros((2, 2, 3), np.uint8), "png")


def _messages() -> Iterable[bytes]:
    small = payload.encode(np.zeros((2, 2, 3), np.uint8), "zstd")
    for camera, codec, data in (("cam01", "zstd", small), ("cam00", "png", PNG), ("x", "png", PNG)):
        lens = Pinhole(2, 2, 2.0, 2.0, 1.0, 1.0, (0.1, 0.0, 0.0, 0.0))
        sent = frame(camera, codec=codec, payload=data, intrinsics=lens, generated_ns=NOW, held_out=camera == "cam00")
        yield to_request(sent).SerializeToString()
    measured = DepthImage(np.eye(2, dtype=np.uint16), 0.001, lens, sent.pose, 5).encode()
    yield to_request(
        replace(sent, camera="cam01", sequence=1, generated_ns=NOW + 1, depth=measured)
    ).SerializeToString()
    yield pb.PushRequest().SerializeToString()


def _payloads() -> Iterable[bytes]:
    image = np.arange(8 * 8 * 3, dtype=np.uint8).reshape(8, 8, 3)
    for number, codec in enumerate(payload.CODECS):
        yield bytes([number, 8, 8]) + payload.encode(image, codec)


def _depths() -> Iterable[bytes]:
    for counts in (np.arange(64, dtype=np.uint16).reshape(8, 8), np.eye(8, dtype=np.uint16)):  # the second with a table
        yield b"\x08\x08" + DepthImage(counts, 0.001).encode().payload


def _checkpoints() -> Iterable[bytes]:
    with tempfile.TemporaryDirectory() as folder:
        checkpoint.save(Path(folder) / "a", {"x": np.zeros(3, np.float32), "n": np.array(2)}, {"steps": 1})
        yield (Path(folder) / "a").read_bytes()


def _sessions() -> Iterable[bytes]:
    from freshfield.session.writer import SessionWriter

    with tempfile.TemporaryDirectory() as folder:
        writer = SessionWriter(Path(folder) / "a", {"scenario": "fuzz"})
        given = list(_messages())
        for message in (*given[:2], given[3]):  # of two cameras, the last with depth
            writer.frame(pb.PushRequest.FromString(message), NOW)
        writer.close({"dropped": 0})
        yield (Path(folder) / "a").read_bytes()


# What takes an input (a folder for files, the bytes) and says in a word what became of it, raising what must never be
# raised; honest inputs, made here, and how many of all are taken at least; milliseconds of processor time for one: what
# a loop with other callers may be kept, or a reader of files.
SHIPPED = partial(map, Path.read_bytes, sorted(scenario.SCENARIO_FOLDER.glob("*.yaml")))
LOAD = partial(checkpoint.load, most_bytes=10**6)
TARGETS = {
    "request": (request, _messages, 3, 50.0),
    "payload": (pixels, _payloads, 3, 200.0),
    "depth": (depths, _depths, 2, 50.0),
    "scenario": (of_file("a.yaml", scenarios, scenario.ScenarioError), SHIPPED, 15, 2000.0),
    "checkpoint": (of_file("a.npz", LOAD, checkpoint.CheckpointError), _checkpoints, 1, 2000.0),
    "mcap": (of_file("a.mcap", mcap, SessionError), _sessions, 1, 2000.0),
}
ACCEPTED = ("accepted", "read", "jpeg", "png", "zstd", "depth")


@pytest.mark.parametrize("name", TARGETS)
def test_what_strangers_send_is_taken_or_refused(name, tmp_path):
    take, honest, least, most_ms = TARGETS[name]
    try:
        given = [*honest(), *(file.read_bytes() for file in sorted((CORPUS / name).glob("*")))]
    except SessionError as error:
        pytest.skip(str(error))
    assert sum(take(tmp_path, data) in ACCEPTED for data in given) >= least
    rng = random.Random(1)
    for data in given:
        for _ in range(40 if most_ms < 2000.0 else 10):
            cut, width, byte = rng.randrange(len(data) + 1), rng.choice((0, 1, 8)), rng.randbytes(1)
            changed = data[:cut] + byte * rng.choice((0, 1, 8)) + data[cut + width :]
            begun = time.thread_time()
            take(tmp_path, changed)
            took_ms = (time.thread_time() - begun) * 1e3
            assert took_ms < most_ms or work_ms(partial(take, tmp_path, changed)) < most_ms
