"""Messages are read as they were written."""

from __future__ import annotations

import struct
from dataclasses import fields

import numpy as np

from edge_server.page.splats.messages import (
    KnotsBlock,
    MovingBlock,
    SceneBlock,
    StaticBlock,
    StatusBlock,
    UnseenBlock,
    write_block,
    write_message,
)
from edge_server.page.splats.records import to_records
from tests.edge_server.page.splats.gaussians import gaussians, motion
from tests.edge_server.page.splats.stream_reader import displacements_at, read_message

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


def test_displacements_are_those_of_the_motion():
    first, knots = motion().newest_knots(6)
    block = KnotsBlock(0, first / 15.0, 15.0, 10.0, 0.3, knots)
    for instant_s in np.arange(first + 1.0, first + 8.0, 0.37) / 15.0:  # also past the last knot
        np.testing.assert_allclose(displacements_at(block, instant_s), motion().at(instant_s), atol=1e-6)
