"""Reads the splat stream, as docs/splat-stream.md specifies it: the reference for readers such as ``reader.js``, which
also bounds what it reads. Blocks of a kind that it does not know are left out."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, POSITION, QUATERNION, SCALE
from edge_server.page.splats.messages import (
    BLOCK,
    HEAD,
    KINDS,
    KNOTS,
    MOVING,
    SCENE,
    STATIC,
    UNSEEN,
    Block,
    KnotsBlock,
    MovingBlock,
    SceneBlock,
    StaticBlock,
    StatusBlock,
    UnseenBlock,
)
from edge_server.page.splats.records import PLACE_STEP, RECORD, TURN_STEP, ZONE
from edge_server.page.splats.settings import COLOR_LOW, COLOR_STEP, VERSION


def _scene(content: bytes) -> SceneBlock:
    version, field, x, y, z, radius_m, near, *background = SCENE.unpack_from(content)
    assert version == VERSION
    return SceneBlock(field, (x, y, z), radius_m, near, tuple(background))


def _static(content: bytes) -> StaticBlock:
    number, total, first, count, low, high = STATIC.unpack_from(content)
    return StaticBlock(number, total, first, (low, high), np.frombuffer(content, RECORD, count, STATIC.size))


def _moving(content: bytes) -> MovingBlock:
    anchors, count, low, high = MOVING.unpack_from(content)
    end = MOVING.size + RECORD.itemsize * count
    records = np.frombuffer(content, RECORD, count, MOVING.size)
    anchor = np.frombuffer(content, np.uint8, 3 * count, end).reshape(count, 3)
    share = np.frombuffer(content, np.uint8, 2 * count, end + 3 * count).reshape(count, 2)
    return MovingBlock(anchors, (low, high), records, anchor, share)


def _knots(content: bytes) -> KnotsBlock:
    set_number, first_s, newest_s, rate, ahead_s, unit, count, anchors = KNOTS.unpack_from(content)
    values = np.frombuffer(content, "<i2", 3 * count * anchors, KNOTS.size).reshape(count, anchors, 3)
    return KnotsBlock(set_number, first_s, rate, newest_s, ahead_s, values.astype(np.float32) * np.float32(unit))


def _unseen(content: bytes) -> UnseenBlock:
    number, count = UNSEEN.unpack_from(content)
    bits = np.unpackbits(np.frombuffer(content, np.uint8, offset=UNSEEN.size), count=count, bitorder="little")
    return UnseenBlock(number, bits.astype(np.bool_))


_READERS = {
    KINDS[SceneBlock]: _scene,
    KINDS[StaticBlock]: _static,
    KINDS[MovingBlock]: _moving,
    KINDS[KnotsBlock]: _knots,
    KINDS[StatusBlock]: lambda content: StatusBlock(json.loads(content)),
    KINDS[UnseenBlock]: _unseen,
}


def read_message(data: bytes) -> tuple[int, float, list[Block]]:
    """Number, instant and blocks of a message."""
    number, instant_s = HEAD.unpack_from(data)
    blocks, at = list[Block](), HEAD.size
    while at < len(data):
        kind, length = BLOCK.unpack_from(data, at)
        at += BLOCK.size
        if kind in _READERS:
            blocks.append(_READERS[kind](data[at : at + length]))
        at += length + -length % 4
    return number, instant_s, blocks


class StreamReader:
    """What a browser would show after the messages read so far: the reference for other readers.

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
        """Take a message in."""
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
                self.status = block.status

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
        assert block.total == len(self.params)
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


def from_records(records: NDArray[np.void], scales: tuple[float, float]) -> NDArray[np.float32]:
    """Gaussians, float32 (N, 14), that draw as the records do: the inverse of ``to_records`` up to rounding and the
    names of axes."""
    out = np.zeros((len(records), BASE), np.float32)
    low, high = scales
    out[:, POSITION:SCALE] = expand(records["place"] * PLACE_STEP - 2.0)
    out[:, SCALE:QUATERNION] = low + records["scale"] * ((high - low) / 255.0)
    out[:, QUATERNION] = 1.0
    out[:, QUATERNION + 1 : OPACITY] = records["turn"] * TURN_STEP - ZONE
    alpha = np.clip(records["alpha"] / 255.0, 1e-4, 1.0 - 1e-4)
    out[:, OPACITY] = np.log(alpha / (1.0 - alpha))
    out[:, COLOR:BASE] = COLOR_LOW + records["color"] * COLOR_STEP
    return out


def expand(places: NDArray) -> NDArray:
    """The inverse of ``contract``."""
    far = np.abs(places) > 1.0
    return np.where(far, np.sign(places) / np.maximum(2.0 - np.abs(places), 1e-6), places)
