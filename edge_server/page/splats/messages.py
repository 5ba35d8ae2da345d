"""Messages of the splat stream (docs/splat-stream.md).

A message is a head (number, instant) and blocks, little endian: kind, length in bytes, content, filled up to four
bytes. Blocks of a kind that a reader does not know are left out.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.page.splats.settings import VERSION

HEAD = struct.Struct("<Id")
BLOCK = struct.Struct("<II")
SCENE = struct.Struct("<II3fff3f")
STATIC = struct.Struct("<IIII2f")
MOVING = struct.Struct("<II2f")
KNOTS = struct.Struct("<Iddfffhh")
UNSEEN = struct.Struct("<II")


@dataclass(frozen=True)
class SceneBlock:
    """What holds for all Gaussians of a field.

    field: another number means another field: what was received before is void.
    center_m: (3,), world meters, of the scene's origin. radius_m: a scene unit. near: scene units, from which on
    Gaussians are drawn. background: RGB (3,).
    """

    field: int
    center_m: tuple[float, float, float]
    radius_m: float
    near: float
    background: tuple[float, float, float]

    def content(self) -> bytes:
        numbers = (*self.center_m, self.radius_m, self.near, *self.background)
        return SCENE.pack(VERSION, self.field, *numbers)


@dataclass(frozen=True)
class StaticBlock:
    """Gaussians ``first`` and following of static set ``set_number``, which has ``total``.

    records: RECORD (N,). scales: log scales of bytes 0 and 255. A set is shown once all of it has come; later blocks
    of the same set replace Gaussians one by one.
    """

    set_number: int
    total: int
    first: int
    scales: tuple[float, float]
    records: NDArray[np.void]

    def content(self) -> bytes:
        head = self.set_number, self.total, self.first, len(self.records)
        return STATIC.pack(*head, *self.scales) + self.records.tobytes()


@dataclass(frozen=True)
class MovingBlock:
    """The moving set, as a whole. records: RECORD (N,), where displacements are 0. anchor: uint8 (N, 3). share: uint8
    (N, 2), of 255, of the first two; the third has the rest. anchors: number of the set of anchors, see KnotsBlock."""

    anchors: int
    scales: tuple[float, float]
    records: NDArray[np.void]
    anchor: NDArray[np.uint8]
    share: NDArray[np.uint8]

    def content(self) -> bytes:
        parts = self.records.tobytes(), self.anchor.tobytes(), self.share.tobytes()
        return MOVING.pack(self.anchors, len(self.records), *self.scales) + b"".join(parts)


@dataclass(frozen=True)
class KnotsBlock:
    """Displacements of the anchors at the newest knots.

    anchors: number of the set of anchors: moving sets with another number are not moved by these.
    first_s: instant of the first knot; those that follow are 1 / knots_per_s apart. newest_s: instant of the newest
    frame; nothing is shown more than ahead_s after it. Instants are seconds since the run began.
    displacements: float32 (K, A, 3), scene units; sent as 16 bits of the largest one.
    """

    anchors: int
    first_s: float
    knots_per_s: float
    newest_s: float
    ahead_s: float
    displacements: NDArray[np.float32]

    def content(self) -> bytes:
        count, anchors = self.displacements.shape[:2]
        unit = max(float(np.abs(self.displacements).max(initial=0.0)), 1e-6) / 32767
        head = self.anchors, self.first_s, self.newest_s, self.knots_per_s, self.ahead_s, unit, count, anchors
        return KNOTS.pack(*head) + np.rint(self.displacements / unit).astype("<i2").tobytes()


@dataclass(frozen=True)
class StatusBlock:
    """Cameras, ages, the visitor's link: see docs/splat-stream.md."""

    status: dict[str, Any]

    def content(self) -> bytes:
        return json.dumps(self.status, separators=(",", ":")).encode()


@dataclass(frozen=True)
class UnseenBlock:
    """bits: bool (N,), which Gaussians of static set ``set_number`` stand where no camera has measured anything."""

    set_number: int
    bits: NDArray[np.bool_]

    def content(self) -> bytes:
        return UNSEEN.pack(self.set_number, len(self.bits)) + np.packbits(self.bits, bitorder="little").tobytes()


Block = SceneBlock | StaticBlock | MovingBlock | KnotsBlock | StatusBlock | UnseenBlock
KINDS: dict[type[Block], int] = {
    SceneBlock: 1,
    StaticBlock: 2,
    MovingBlock: 3,
    KnotsBlock: 4,
    StatusBlock: 5,
    UnseenBlock: 6,
}


def write_message(number: int, instant_s: float, blocks: list[Block]) -> bytes:
    """A message. number: counts from 0, modulo 2^32. instant_s: the edge's present, seconds since the run began."""
    return join_blocks(number, instant_s, map(write_block, blocks))


def join_blocks(number: int, instant_s: float, blocks: Iterable[bytes]) -> bytes:
    """``write_message`` of blocks that are written already."""
    return HEAD.pack(number & 0xFFFFFFFF, instant_s) + b"".join(blocks)


def write_block(block: Block) -> bytes:
    """A block with its head."""
    content = block.content()
    return BLOCK.pack(KINDS[type(block)], len(content)) + content + bytes(-len(content) % 4)
