"""Reads the frames of a recorded session, also of a truncated file. Indexes the file first; payloads are read
on request."""

from __future__ import annotations

import os
import struct
import threading
import zlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

from freshfield.depth import EncodedDepth
from freshfield.frame import depth_of
from freshfield.session import DEPTH, HEADER, IMAGE, INSTALL, SessionError
from freshfield.v1 import frames_pb2 as pb

try:
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from google.protobuf.message import DecodeError
    from mcap.data_stream import ReadDataStream
    from mcap.exceptions import McapError
    from mcap.opcode import Opcode
    from mcap.records import Channel, Message
    from mcap.writer import MCAP0_MAGIC
except ImportError:
    raise SessionError(INSTALL) from None

_IN_CHUNKS = (Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_RECORD_HEAD = struct.Struct("<BQ")
# Start and end time, uncompressed size, checksum, length of the compression's name.
_CHUNK_HEAD = struct.Struct("<QQQII")
# What damaged records raise.
_UNREADABLE = (McapError, struct.error, ValueError, EOFError)


class _Location(NamedTuple):
    """Location of a message's record in the file."""

    offset: int
    size: int


@dataclass(frozen=True)
class SessionFrame:
    """A recorded frame whose payload is still in the file.

    arrived_ns: arrival on the edge's clock. depth_location: None if the frame has no depth.
    """

    header: pb.FrameHeader
    arrived_ns: int
    location: _Location
    depth_location: _Location | None = None


class Session:
    """A recording, opened and indexed. Thread-safe.

    frames: by camera, in the order of arrival.
    messages: number of complete messages by topic.
    cut: one line on what is missing if the file was not closed or is damaged; else None.
    Raises SessionError if it is not an MCAP file, OSError if it cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.frames: dict[str, list[SessionFrame]] = {}
        self.messages: Counter[str] = Counter()
        self.cut: str | None = None
        self._channels: dict[int, str] = {}
        self._headers: dict[str, tuple[int, int, pb.FrameHeader]] = {}
        self._depths: dict[str, _Location] = {}  # of the frames whose header is read and whose image is not
        self._damaged = 0
        self._file = path.open("rb")
        self._lock = threading.Lock()
        self._size = os.fstat(self._file.fileno()).st_size
        self._compressed = 0
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise SessionError(f"{path}: is not an MCAP file")
        end = self._read_all()
        parts = []
        if end is not None:
            where = f"cut short at byte {end} of {self._size}"
            parts.append(where if end < self._size else f"never closed, ends at byte {end}")
        if self._damaged:
            parts.append(f"{self._damaged} damaged chunks or records left out")
        if self._compressed:
            parts.append(f"{self._compressed} compressed chunks left out (`mcap decompress` rewrites them)")
        if parts:
            self.cut = f"{path}: {', '.join(parts)}: {sum(self.messages.values())} complete messages are used"

    def payload(self, frame: SessionFrame) -> bytes:
        """The payload of one of ``frames``, byte for byte. Raises SessionError if it cannot be read again."""
        return bytes(self._read_again(CompressedImage, frame.location).data)

    def depth(self, frame: SessionFrame) -> EncodedDepth | None:
        """The depth of one of ``frames``, as received; None if it has none. Raises as ``payload``."""
        return None if frame.depth_location is None else depth_of(self._read_again(pb.Depth, frame.depth_location))

    def _read_again(self, kind: type[Any], location: _Location) -> Any:
        try:
            return kind.FromString(_message(self._at(*location)).data)
        except (DecodeError, *_UNREADABLE) as error:
            raise SessionError(f"{self.path}: a message cannot be read again: {error}") from None

    def close(self) -> None:
        self._file.close()

    def _at(self, offset: int, size: int) -> bytes:
        with self._lock:
            self._file.seek(offset)
            return self._file.read(size)

    # --- the index --------------------------------------------------------------------------------

    def _read_all(self) -> int | None:
        """Index every complete message. Returns the end of the complete part, None for a closed file."""
        heads: list[tuple[int, int, int]] = []
        end: int | None = len(MCAP0_MAGIC)
        for opcode, at, size in _heads(self._at, len(MCAP0_MAGIC), self._size):
            heads.append((opcode, at, size))
            if at + size <= self._size:
                end = at + size
                if opcode == Opcode.FOOTER:
                    end = None
                    break
        # Channels first: a closed file repeats them at its end, so a damaged chunk loses only its messages.
        for wanted in (Opcode.CHANNEL, None):
            for opcode, at, size in heads:
                whole = at + size <= self._size
                if opcode == Opcode.CHUNK and wanted is None:
                    self._chunk(at, min(size, self._size - at), whole)
                elif whole and opcode == (wanted or Opcode.MESSAGE):
                    self._record(opcode, self._at(at, size), _Location(at, size))
        return end

    def _chunk(self, at: int, size: int, whole: bool) -> None:
        if size < _CHUNK_HEAD.size:
            return
        data = self._at(at, size)
        *_, crc, name = _CHUNK_HEAD.unpack_from(data)
        begin = _CHUNK_HEAD.size + name + 8
        if name:
            self._compressed += 1
            return
        if whole and crc and zlib.crc32(data[begin:]) != crc:
            self._damaged += 1
            return
        for opcode, offset, length in _heads(lambda start, count: data[start : start + count], begin, len(data)):
            if offset + length > len(data):
                return
            if opcode not in _IN_CHUNKS:
                self._damaged += 1
                return
            self._record(opcode, data[offset : offset + length], _Location(at + offset, length))

    def _record(self, opcode: int, body: bytes, location: _Location) -> None:
        try:
            self._index(opcode, body, location)
        except _UNREADABLE:  # outside chunks there is no checksum
            self._damaged += 1

    def _index(self, opcode: int, body: bytes, location: _Location) -> None:
        if opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(body)))
            self._channels[channel.id] = channel.topic
        elif opcode == Opcode.MESSAGE:
            message = _message(body)
            name = self._channels.get(message.channel_id)
            if name is None:
                return
            self.messages[name] += 1
            camera, _, kind = name[1:].rpartition("/")
            if kind == HEADER and camera:
                try:
                    header = pb.FrameHeader.FromString(message.data)
                except DecodeError:
                    return
                self._headers[camera] = (message.log_time, message.publish_time, header)
                self._depths.pop(camera, None)
            elif kind == DEPTH and camera:
                self._depths[camera] = location
            elif kind == IMAGE and camera:
                # The image follows its header; without one it is not a frame.
                before, depth = self._headers.pop(camera, None), self._depths.pop(camera, None)
                if before is not None and before[:2] == (message.log_time, message.publish_time):
                    self.frames.setdefault(camera, []).append(SessionFrame(before[2], before[0], location, depth))


def _heads(read: Callable[[int, int], bytes], at: int, end: int) -> Iterator[tuple[int, int, int]]:
    """(opcode, offset, size) of the records from ``at`` to ``end``, the last perhaps truncated. read: (offset, size) to
    bytes."""
    while at + _RECORD_HEAD.size <= end:
        opcode, size = _RECORD_HEAD.unpack(read(at, _RECORD_HEAD.size))
        yield opcode, at + _RECORD_HEAD.size, size
        at += _RECORD_HEAD.size + size


def _message(body: bytes) -> Message:
    return Message.read(ReadDataStream(BytesIO(body)), len(body))
