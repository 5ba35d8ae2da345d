"""Messages are read as they were written; what is no message is refused and changes nothing."""

from __future__ import annotations

import struct
from dataclasses import fields

import numpy as np
import pytest

from edge_server.page.splats import messages
from edge_server.page.splats.messages import (
    HEAD,
    KnotsBlock,
    MessageError,
    MovingBlock,
    SceneBlock,
    StaticBlock,
    StatusBlock,
    StreamReader,
    UnseenBlock,
    displacements_at,
    read_message,
    write_block,
    write_message,
)
from edge_server.page.splats.records import from_records, to_records
from tests.edge_server.page.splats.gaussians import gaussians, motion

SCALES = (-5.0, -2.0)
RECORDS = to_records(gaussians(40, 0), SCALES)
SCENE = SceneBlock(3, (1.0, 2.0, 3.0), 2.0, 0.125, (0.0, 0.5, 1.0))
ANCHOR = np.arange(120, dtype=np.uint8).reshape(40, 3) % 5
SHARE = np.full((40, 2), 100, np.uint8)
KNOTS = KnotsBlock(8, 10.0, 15.0, 10.5, 0.25, np.linspace(-0.5, 0.7, 4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3))
BLOCKS = [
    SCENE,
    StaticBlock(1, 60, 20, SCALES, RECORDS),
    MovingBlock(8, SCALES, RECORDS, ANCHOR, SHARE),
    KNOTS,
    UnseenBlock(1, np.arange(60) % 7 == 0),
    StatusBlock({"line": "é", "cameras": []}),
]


def test_every_block_comes_back():
    number, instant_s, found = read_message(write_message(2**32 + 5, 12.5, BLOCKS))
    assert (number, instant_s) == (5, 12.5) and len(found) == len(BLOCKS)
    for wanted, got in zip(BLOCKS, found):
        for name in {field.name for field in fields(wanted)} - {"displacements"}:
            np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))
    np.testing.assert_allclose(found[3].displacements, KNOTS.displacements, atol=0.7 / 32767)


def test_blocks_of_kinds_to_come_are_left_out():
    unknown = struct.pack("<II", 99, 5) + b"abcde" + bytes(3)
    data = write_message(0, 0.0, [SCENE]) + unknown + write_block(BLOCKS[5])
    assert read_message(data)[2] == [SCENE, BLOCKS[5]]


@pytest.mark.stability
def test_a_message_that_is_cut_off_is_refused():
    for block in BLOCKS:
        data = write_message(0, 0.0, [block])
        for length in (0, HEAD.size - 1, HEAD.size + 3, HEAD.size + 8, len(data) - 8):
            with pytest.raises(MessageError):
                read_message(data[:length])


def lying(block, *numbers):
    """A message whose block has other uint32 numbers at its start."""
    data = bytearray(write_message(0, 0.0, [block]))
    at = HEAD.size + 8
    for k, number in numbers:
        struct.pack_into("<I", data, at + 4 * k, number)
    return bytes(data)


@pytest.mark.stability
@pytest.mark.parametrize(
    "data",
    [
        lying(SCENE, (0, 2)),  # another version
        lying(SCENE, (2, 0x7FC00000)),  # NaN
        lying(BLOCKS[1], (2, 21)),  # one more than there are
        lying(BLOCKS[1], (3, 39)),
        lying(BLOCKS[2], (1, 41)),
        lying(BLOCKS[3], (8, 3)),
        lying(BLOCKS[3], (5, 0)),  # no knots a second
        lying(BLOCKS[4], (1, 2**31)),
        write_message(0, 0.0, []) + struct.pack("<II", messages.STATUS, 4) + b"[1] ",
        write_message(0, float("nan"), []),
    ],
)
def test_a_message_that_lies_is_refused_and_loses_nothing(data):
    reader = StreamReader()
    reader.read(write_message(0, 0.0, [SCENE, StaticBlock(1, 40, 0, SCALES, RECORDS)]))
    before = reader.at(0.0)
    with pytest.raises(MessageError):
        reader.read(data)
    np.testing.assert_array_equal(reader.at(0.0), before)
    assert len(before) == 40


def test_displacements_are_those_of_the_motion():
    first, knots = motion().newest_knots(6)
    block = KnotsBlock(0, first / 15.0, 15.0, 10.0, 0.3, knots)
    for instant_s in np.arange(first + 1.0, first + 8.0, 0.37) / 15.0:  # also past the last knot
        np.testing.assert_allclose(displacements_at(block, instant_s), motion().at(instant_s), atol=1e-6)


def test_a_static_set_is_shown_once_it_is_whole():
    reader = StreamReader()
    first, second = (StaticBlock(1, 40, k, SCALES, RECORDS[k : k + 20]) for k in (0, 20))
    reader.read(write_message(0, 0.0, [SCENE, first]))
    assert len(reader.at(0.0)) == 0
    reader.read(write_message(1, 0.0, [second]))
    np.testing.assert_array_equal(reader.at(0.0), from_records(RECORDS, SCALES))
    reader.read(write_message(2, 0.0, [StaticBlock(2, 40, 0, SCALES, RECORDS[:20])]))
    assert len(reader.at(0.0)) == 40  # the old set stays meanwhile
    reader.read(write_message(3, 0.0, [StaticBlock(1, 40, 5, SCALES, RECORDS[:1])]))
    np.testing.assert_array_equal(reader.at(0.0)[5], from_records(RECORDS[:1], SCALES)[0])
    reader.read(write_message(4, 0.0, [StaticBlock(2, 40, 20, SCALES, RECORDS[:20])]))
    np.testing.assert_array_equal(reader.at(0.0)[20:], from_records(RECORDS[:20], SCALES))


def test_a_moving_set_waits_for_knots_of_its_own_and_another_field_forgets_it():
    reader = StreamReader()
    moving = MovingBlock(9, SCALES, RECORDS, ANCHOR, SHARE)
    reader.read(write_message(0, 0.0, [SCENE, moving, KNOTS]))
    assert len(reader.at(10.0)) == 0  # knots of set 8
    reader.read(write_message(1, 0.0, [BLOCKS[2]]))
    moved = reader.at(10.5) - from_records(RECORDS, SCALES)
    (knots,) = read_message(write_message(0, 0.0, [KNOTS]))[2]
    share = np.array([100, 100, 55])[:, None] / 255.0
    wanted = (displacements_at(knots, 10.5)[ANCHOR] * share).sum(axis=1)
    np.testing.assert_allclose(moved[:, :3], wanted, atol=1e-5)
    np.testing.assert_array_equal(reader.at(10.75), reader.at(99.0))  # no farther ahead than motion is known
    reader.read(write_message(2, 0.0, [SceneBlock(4, (0.0, 0.0, 0.0), 1.0, 0.1, (0.0, 0.0, 0.0))]))
    assert len(reader.at(10.5)) == 0
