"""Writes and reads the messages of the splat stream (docs/splat-stream.md).

A message is a head (number, instant) and blocks, little endian: kind, length in bytes, content, padded to four bytes.
Readers skip blocks of unknown kinds. ``read_message`` is the reference reader; it bounds everything that it reads.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.page.splats.records import RECORD, from_records

VERSION = 1
"""Version of the messages. A reader refuses others."""
MOST_ANCHORS = 255
"""An anchor's index is one byte."""

HEAD = struct.Struct("<Id")
BLOCK = struct.Struct("<II")
SAVED = struct.Struct("<Id")
SCENE, STATIC, MOVING, KNOTS, STATUS, UNSEEN = range(1, 7)

_SCENE = struct.Struct("<II3fff3f")
_STATIC = struct.Struct("<IIII2f")
_MOVING = struct.Struct("<II2f")
_KNOTS = struct.Struct("<Iddfffhh")
_UNSEEN = struct.Struct("<II")
MOST_GAUSSIANS, MOST_KNOTS = 1 << 20, 64


class MessageError(ValueError):
    """A message does not conform to docs/splat-stream.md."""


@dataclass(frozen=True)
class SceneBlock:
    """Parameters common to all Gaussians of a field.

    field: another number means another field, which voids everything received before.
    center_m: (3,), world meters, of the scene's origin. radius_m: a scene unit. near: scene units, from which on
    Gaussians are drawn. background: RGB (3,).
    """

    field: int
    center_m: tuple[float, float, float]
    radius_m: float
    near: float
    background: tuple[float, float, float]


@dataclass(frozen=True)
class StaticBlock:
    """Gaussians ``first`` and following of static set ``set_number``, which has ``total``.

    records: RECORD (N,). scales: log scales of bytes 0 and 255. A set is shown once it is complete; later blocks of
    the same set replace Gaussians one by one.
    """

    set_number: int
    total: int
    first: int
    scales: tuple[float, float]
    records: NDArray[np.void]


@dataclass(frozen=True)
class MovingBlock:
    """The whole moving set. records: RECORD (N,), at zero displacement. anchor: uint8 (N, 3). share: uint8 (N, 2), of
    255, weights of the first two anchors; the third has the rest. anchors: number of the anchor set, see KnotsBlock."""

    anchors: int
    scales: tuple[float, float]
    records: NDArray[np.void]
    anchor: NDArray[np.uint8]
    share: NDArray[np.uint8]


@dataclass(frozen=True)
class KnotsBlock:
    """Displacements of the anchors at the newest knots.

    anchors: number of the anchor set; these knots do not apply to moving sets with another number.
    first_s: instant of the first knot; the others follow 1 / knots_per_s apart. newest_s: instant of the newest
    frame; nothing is shown more than ahead_s after it. Instants are seconds since the run began.
    displacements: float32 (K, A, 3), scene units.
    """

    anchors: int
    first_s: float
    knots_per_s: float
    newest_s: float
    ahead_s: float
    displacements: NDArray[np.float32]


@dataclass(frozen=True)
class UnseenBlock:
    """bits: bool (N,), which Gaussians of static set ``set_number`` are at places where no camera measured anything."""

    set_number: int
    bits: NDArray[np.bool_]


@dataclass(frozen=True)
class StatusBlock:
    """Cameras, ages, the visitor's link: see docs/splat-stream.md."""

    content: dict[str, Any]


Block = SceneBlock | StaticBlock | MovingBlock | KnotsBlock | UnseenBlock | StatusBlock


def write_message(number: int, instant_s: float, blocks: Iterable[Block | bytes]) -> bytes:
    """A message. number: counts from 0, modulo 2^32. instant_s: the edge's present, seconds since the run began.
    blocks: as objects, or as ``write_block`` encoded them."""
    written = (block if isinstance(block, bytes) else write_block(block) for block in blocks)
    return HEAD.pack(number & 0xFFFFFFFF, instant_s) + b"".join(written)


def write_block(block: Block) -> bytes:
    """Encode a block with its head."""
    kind, content = _content(block)
    return BLOCK.pack(kind, len(content)) + content + bytes(-len(content) % 4)


def _content(block: Block) -> tuple[int, bytes]:
    if isinstance(block, SceneBlock):
        numbers = (*block.center_m, block.radius_m, block.near, *block.background)
        return SCENE, _SCENE.pack(VERSION, block.field, *numbers)
    if isinstance(block, StaticBlock):
        head = block.set_number, block.total, block.first, len(block.records)
        return STATIC, _STATIC.pack(*head, *block.scales) + block.records.tobytes()
    if isinstance(block, MovingBlock):
        parts = block.records.tobytes(), block.anchor.tobytes(), block.share.tobytes()
        return MOVING, _MOVING.pack(block.anchors, len(block.records), *block.scales) + b"".join(parts)
    if isinstance(block, KnotsBlock):
        return KNOTS, _knots(block)
    if isinstance(block, UnseenBlock):
        bits = np.packbits(block.bits, bitorder="little").tobytes()
        return UNSEEN, _UNSEEN.pack(block.set_number, len(block.bits)) + bits
    return STATUS, json.dumps(block.content, separators=(",", ":")).encode()


def _knots(block: KnotsBlock) -> bytes:
    """Displacements as 16 bits of the largest one."""
    count, anchors = block.displacements.shape[:2]
    unit = max(float(np.abs(block.displacements).max(initial=0.0)), 1e-6) / 32767
    head = block.anchors, block.first_s, block.newest_s, block.knots_per_s, block.ahead_s, unit, count, anchors
    return _KNOTS.pack(*head) + np.rint(block.displacements / unit).astype("<i2").tobytes()


def read_message(data: bytes) -> tuple[int, float, list[Block]]:
    """Number, instant and blocks of a message. Raises MessageError."""
    if len(data) < HEAD.size:
        raise MessageError(f"a message has at least {HEAD.size} bytes, not {len(data)}")
    number, instant_s = HEAD.unpack_from(data)
    if not np.isfinite(instant_s):
        raise MessageError("the instant is not finite")
    return number, instant_s, [block for block in _blocks(data) if block is not None]


def _blocks(data: bytes) -> Iterator[Block | None]:
    at = HEAD.size
    while at < len(data):
        if len(data) - at < BLOCK.size:
            raise MessageError("a block's head is cut off")
        kind, length = BLOCK.unpack_from(data, at)
        at += BLOCK.size
        if length > len(data) - at:
            raise MessageError(f"a block of kind {kind} is cut off")
        try:
            yield _read_block(kind, data[at : at + length])
        except (struct.error, ValueError) as error:
            raise MessageError(f"a block of kind {kind}: {error}") from None
        at += length + -length % 4


def _read_block(kind: int, content: bytes) -> Block | None:
    readers: dict[int, Callable[[bytes], Block]] = {
        SCENE: _scene,
        STATIC: _static,
        MOVING: _moving,
        KNOTS: _read_knots,
        STATUS: _status,
        UNSEEN: _unseen,
    }
    return readers[kind](content) if kind in readers else None


def _scene(content: bytes) -> SceneBlock:
    version, field, *numbers = _SCENE.unpack_from(content)
    if version != VERSION:
        raise MessageError(f"version {version} of the stream; this reader knows {VERSION}")
    _finite(*numbers)
    if numbers[3] <= 0.0:
        raise MessageError("a scene unit has no length")
    return SceneBlock(field, (numbers[0], numbers[1], numbers[2]), numbers[3], numbers[4], tuple(numbers[5:8]))  # type: ignore[arg-type]


def _static(content: bytes) -> StaticBlock:
    number, total, first, count, low, high = _STATIC.unpack_from(content)
    if total > MOST_GAUSSIANS or first + count > total:
        raise MessageError(f"Gaussians {first} to {first + count} of {total}")
    _finite(low, high)
    _length(content, _STATIC.size + RECORD.itemsize * count)
    return StaticBlock(number, total, first, (low, high), np.frombuffer(content, RECORD, count, _STATIC.size))


def _moving(content: bytes) -> MovingBlock:
    anchors, count, low, high = _MOVING.unpack_from(content)
    if count > MOST_GAUSSIANS:
        raise MessageError(f"{count} Gaussians")
    _finite(low, high)
    end = _MOVING.size + RECORD.itemsize * count
    _length(content, end + 5 * count)
    records = np.frombuffer(content, RECORD, count, _MOVING.size)
    anchor = np.frombuffer(content, np.uint8, 3 * count, end).reshape(count, 3)
    share = np.frombuffer(content, np.uint8, 2 * count, end + 3 * count).reshape(count, 2)
    return MovingBlock(anchors, (low, high), records, anchor, share)


def _read_knots(content: bytes) -> KnotsBlock:
    set_number, first_s, newest_s, rate, ahead_s, unit, count, anchors = _KNOTS.unpack_from(content)
    if not (4 <= count <= MOST_KNOTS and 0 <= anchors <= MOST_ANCHORS):
        raise MessageError(f"{count} knots of {anchors} anchors")
    _finite(first_s, rate, newest_s, ahead_s, unit)
    if rate <= 0.0:
        raise MessageError(f"{rate} knots a second")
    _length(content, _KNOTS.size + 6 * count * anchors)
    values = np.frombuffer(content, "<i2", 3 * count * anchors, _KNOTS.size).reshape(count, anchors, 3)
    return KnotsBlock(set_number, first_s, rate, newest_s, ahead_s, values.astype(np.float32) * np.float32(unit))


def _unseen(content: bytes) -> UnseenBlock:
    number, count = _UNSEEN.unpack_from(content)
    if count > MOST_GAUSSIANS:
        raise MessageError(f"{count} Gaussians")
    _length(content, _UNSEEN.size + -(-count // 8))
    bits = np.unpackbits(np.frombuffer(content, np.uint8, offset=_UNSEEN.size), count=count, bitorder="little")
    return UnseenBlock(number, bits.astype(np.bool_))


def _status(content: bytes) -> StatusBlock:
    found = json.loads(content)
    if not isinstance(found, dict):
        raise MessageError("a status is a JSON object")
    return StatusBlock(found)


def _finite(*numbers: float) -> None:
    if not np.isfinite(numbers).all():
        raise MessageError(f"numbers that are not finite: {numbers}")


def _length(content: bytes, wanted: int) -> None:
    if len(content) != wanted:
        raise MessageError(f"{len(content)} bytes instead of {wanted}")


def read_saved(data: bytes) -> Iterator[tuple[float, bytes]]:
    """The messages of a saved stream, each with its arrival time in seconds. Ends where the file is truncated."""
    at = 0
    while at + SAVED.size <= len(data):
        size, came_s = SAVED.unpack_from(data, at)
        at += SAVED.size
        if size > len(data) - at:
            return
        yield came_s, data[at : at + size]
        at += size


class StreamReader:
    """The state of a browser after the messages read so far: the reference for other readers.

    scene: None before the first. instant_s: of the newest message, the edge's present. params: see ``at``.
    """

    def __init__(self) -> None:
        self.scene: SceneBlock | None = None
        self.status: dict[str, Any] = {}
        self.instant_s = 0.0
        self._forget()

    def _forget(self) -> None:
        self._shown, self._pending = _StaticSet(), _StaticSet()
        self._moving: MovingBlock | None = None
        self._knots: KnotsBlock | None = None

    def read(self, data: bytes) -> None:
        """Process a message. Raises MessageError; the state from earlier messages stays."""
        _, self.instant_s, blocks = read_message(data)
        for block in blocks:
            if isinstance(block, SceneBlock):
                if self.scene is not None and self.scene.field != block.field:
                    self._forget()
                self.scene = block
            elif isinstance(block, StaticBlock):
                self._take_static(block)
            elif isinstance(block, MovingBlock):
                self._moving = block
            elif isinstance(block, KnotsBlock):
                self._knots = block
            elif isinstance(block, StatusBlock):
                self.status = block.content

    def _take_static(self, block: StaticBlock) -> None:
        target = self._shown if block.set_number == self._shown.number else self._pending
        if target.number != block.set_number:
            target = self._pending = _StaticSet(block.set_number, block.total)
        target.take(block)
        if target is self._pending and target.complete:
            self._shown, self._pending = target, _StaticSet()

    def at(self, instant_s: float) -> NDArray[np.float32]:
        """Gaussians to draw at an instant, float32 (N, 14), scene units: parameters of a Gaussian of degree 0."""
        moving, knots = self._moving, self._knots
        if moving is None or knots is None or moving.anchors != knots.anchors:
            return self._shown.params
        params = from_records(moving.records, moving.scales)
        moved = displacements_at(knots, min(instant_s, knots.newest_s + knots.ahead_s))
        if not (moving.anchor < len(moved)).all():
            return self._shown.params
        share = np.concatenate([moving.share, 255 - moving.share.sum(axis=1, keepdims=True, dtype=np.int32)], axis=1)
        params[:, :3] += np.einsum("nk,nkc->nc", share / np.float32(255.0), moved[moving.anchor])
        return np.concatenate([self._shown.params, params])


class _StaticSet:
    """A static set that is being received. number: -1 for none."""

    def __init__(self, number: int = -1, total: int = 0) -> None:
        self.number = number
        self.params = np.zeros((total, 14), np.float32)
        self._came = np.zeros(total, np.bool_)

    @property
    def complete(self) -> bool:
        return bool(self._came.all())

    def take(self, block: StaticBlock) -> None:
        if block.total != len(self.params):
            raise MessageError(f"a static set of {len(self.params)} Gaussians now has {block.total}")
        there = slice(block.first, block.first + len(block.records))
        self.params[there] = from_records(block.records, block.scales)
        self._came[there] = True


def displacements_at(block: KnotsBlock, instant_s: float) -> NDArray[np.float32]:
    """Displacements (A, 3) at an instant: a Catmull-Rom spline, and a straight line past the last knot and before the
    first (``fields.splat.layers.motion``)."""
    knots, last = block.displacements, len(block.displacements) - 1
    x = max((instant_s - block.first_s) * block.knots_per_s, 0.0)
    i = min(int(x), last)
    f = np.float32(x - i)
    if i == last:
        return knots[last] + f * (knots[last] - knots[last - 1])
    a, b = knots[i], knots[i + 1]
    before = knots[i - 1] if i > 0 else 2 * a - b
    after = knots[i + 2] if i + 1 < last else 2 * b - a
    return a + f / 2 * (b - before + f * (2 * before - 5 * a + 4 * b - after + f * (3 * (a - b) + after - before)))
