"""What the field publishes, as records in messages: the same picture; what is no message is refused."""

import struct
from dataclasses import fields, replace

import numpy as np
import pytest

from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.page.splats import messages
from edge_server.page.splats import records as packing
from edge_server.page.splats.published import Published, Publisher
from freshfield.geometry import quaternion_to_matrix
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.page.splats.gaussians import BOX, LENS, NEWEST_S, ORIGIN_NS, POSE, gaussians, motion, snapshot
from tests.support import refused

SCALES = (-5.0, -2.0)
RECORDS = packing.to_records(gaussians(40, 0), SCALES)
SCENE = messages.SceneBlock(3, (1.0, 2.0, 3.0), 2.0, 0.125, (0.0, 0.5, 1.0))
ANCHOR = np.arange(120, dtype=np.uint8).reshape(40, 3) % 5
SHARE = np.full((40, 2), 100, np.uint8)
KNOTS = messages.KnotsBlock(
    8, 10.0, 15.0, 10.5, 0.25, np.linspace(-0.5, 0.7, 4 * 5 * 3, dtype=np.float32).reshape(4, 5, 3)
)
BLOCKS = [
    SCENE,
    messages.StaticBlock(1, 60, 20, SCALES, RECORDS),
    messages.MovingBlock(8, SCALES, RECORDS, ANCHOR, SHARE),
    KNOTS,
    messages.UnseenBlock(1, np.arange(60) % 7 == 0),
    messages.StatusBlock({"line": "é", "cameras": []}),
]


def test_every_block_comes_back_but_those_of_kinds_to_come():
    number, instant_s, found = messages.read_message(messages.write_message(2**32 + 5, 12.5, BLOCKS))
    assert (number, instant_s) == (5, 12.5) and len(found) == len(BLOCKS)
    for wanted, got in zip(BLOCKS, found):
        for name in {field.name for field in fields(wanted)} - {"displacements"}:
            np.testing.assert_array_equal(getattr(got, name), getattr(wanted, name))
    np.testing.assert_allclose(found[3].displacements, KNOTS.displacements, atol=0.7 / 32767)
    unknown = struct.pack("<II", 99, 5) + b"abcde" + bytes(3)
    data = messages.write_message(0, 0.0, [SCENE]) + unknown + messages.write_block(BLOCKS[5])
    assert messages.read_message(data)[2] == [SCENE, BLOCKS[5]]


@pytest.mark.stability
def test_a_message_that_is_cut_off_is_refused():
    for block in BLOCKS:
        data = messages.write_message(0, 0.0, [block])
        for length in (0, messages.HEAD.size - 1, messages.HEAD.size + 3, messages.HEAD.size + 8, len(data) - 8):
            refused(messages.MessageError, "", messages.read_message, data[:length])


def lying(block, *numbers):
    """A message whose block has other uint32 numbers at its start."""
    data = bytearray(messages.write_message(0, 0.0, [block]))
    at = messages.HEAD.size + 8
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
        messages.write_message(0, 0.0, []) + struct.pack("<II", messages.STATUS, 4) + b"[1] ",
        messages.write_message(0, float("nan"), []),
    ],
)
def test_a_message_that_lies_is_refused_and_loses_nothing(data):
    reader = messages.StreamReader()
    reader.read(messages.write_message(0, 0.0, [SCENE, messages.StaticBlock(1, 40, 0, SCALES, RECORDS)]))
    before = reader.at(0.0)
    refused(messages.MessageError, "", reader.read, data)
    np.testing.assert_array_equal(reader.at(0.0), before)
    assert len(before) == 40


def test_displacements_are_those_of_the_motion():
    first, knots = motion().newest_knots(6)
    block = messages.KnotsBlock(0, first / 15.0, 15.0, 10.0, 0.3, knots)
    for instant_s in np.arange(first + 1.0, first + 8.0, 0.37) / 15.0:  # also past the last knot
        np.testing.assert_allclose(messages.displacements_at(block, instant_s), motion().at(instant_s), atol=1e-6)


def test_a_static_set_is_shown_once_it_is_whole():
    reader = messages.StreamReader()
    first, second = (messages.StaticBlock(1, 40, k, SCALES, RECORDS[k : k + 20]) for k in (0, 20))
    reader.read(messages.write_message(0, 0.0, [SCENE, first]))
    assert len(reader.at(0.0)) == 0
    reader.read(messages.write_message(1, 0.0, [second]))
    np.testing.assert_array_equal(reader.at(0.0), packing.from_records(RECORDS, SCALES))
    reader.read(messages.write_message(2, 0.0, [messages.StaticBlock(2, 40, 0, SCALES, RECORDS[:20])]))
    assert len(reader.at(0.0)) == 40  # the old set stays meanwhile
    reader.read(messages.write_message(3, 0.0, [messages.StaticBlock(1, 40, 5, SCALES, RECORDS[:1])]))
    np.testing.assert_array_equal(reader.at(0.0)[5], packing.from_records(RECORDS[:1], SCALES)[0])
    reader.read(messages.write_message(4, 0.0, [messages.StaticBlock(2, 40, 20, SCALES, RECORDS[:20])]))
    np.testing.assert_array_equal(reader.at(0.0)[20:], packing.from_records(RECORDS[:20], SCALES))


def test_a_moving_set_waits_for_knots_of_its_own_and_another_field_forgets_it():
    reader = messages.StreamReader()
    moving = messages.MovingBlock(9, SCALES, RECORDS, ANCHOR, SHARE)
    reader.read(messages.write_message(0, 0.0, [SCENE, moving, KNOTS]))
    assert len(reader.at(10.0)) == 0  # knots of set 8
    reader.read(messages.write_message(1, 0.0, [BLOCKS[2]]))
    moved = reader.at(10.5) - packing.from_records(RECORDS, SCALES)
    (knots,) = messages.read_message(messages.write_message(0, 0.0, [KNOTS]))[2]
    share = np.array([100, 100, 55])[:, None] / 255.0
    wanted = (messages.displacements_at(knots, 10.5)[ANCHOR] * share).sum(axis=1)
    np.testing.assert_allclose(moved[:, :3], wanted, atol=1e-5)
    np.testing.assert_array_equal(reader.at(10.75), reader.at(99.0))  # no farther ahead than motion is known
    reader.read(messages.write_message(2, 0.0, [messages.SceneBlock(4, (0.0, 0.0, 0.0), 1.0, 0.1, (0.0, 0.0, 0.0))]))
    assert len(reader.at(10.5)) == 0


def covariances(params):
    turns = np.stack([quaternion_to_matrix(q / np.linalg.norm(q)) for q in params[:, 6:10].astype(float)])
    axes = turns * np.exp(params[:, None, 3:6].astype(float))
    return axes @ axes.transpose(0, 2, 1)


def test_a_record_is_the_same_ellipsoid():
    params = gaussians(500, 3)
    scales = packing.scale_range(params)
    records = packing.to_records(params, scales)
    assert records.itemsize == packing.RECORD.itemsize == 16
    again = packing.from_records(records, scales)
    np.testing.assert_allclose(again[:, :3], params[:, :3], atol=4 * 2.0**-16 * 4)
    wanted, found = covariances(params), covariances(again)
    off = np.linalg.norm(wanted - found, axis=(1, 2)) / np.linalg.norm(wanted, axis=(1, 2))
    assert np.median(off) < 0.01 and off.max() < 0.03
    np.testing.assert_allclose(again[:, 11:14], params[:, 11:14], atol=0.0041)
    alpha = lambda p: 1 / (1 + np.exp(-p[:, 10]))  # noqa: E731
    np.testing.assert_allclose(alpha(again), alpha(params), atol=0.0021)
    turn = packing.to_records(gaussians(20_000, 4), scales)["turn"]
    assert (turn.min(), turn.max()) == (0, 255)  # bytes are neither wasted nor clipped
    there = packing.contract(places := np.array([-100.0, -1.0, -0.3, 0.0, 1.0, 1.5, 20.0]))
    assert np.abs(there).max() < 2.0
    np.testing.assert_allclose(packing.expand(there), places, rtol=1e-12)


@pytest.mark.stability
@pytest.mark.parametrize(
    "column, value",
    [(0, np.nan), (1, np.inf), (4, np.nan), (3, 1e30), (7, np.nan), (10, np.inf), (12, -np.inf), (2, 1e30)],
)
def test_what_cannot_be_drawn_is_not_drawn_and_spoils_nothing(column, value):
    params = gaussians(20, 5).copy()
    params[7, column] = value
    scales = packing.scale_range(params)
    records = packing.to_records(params, scales)
    assert np.isfinite(scales).all() and scales[0] < scales[1]
    assert np.isfinite(packing.from_records(records, scales)).all()
    assert np.isfinite(value) or records["alpha"][7] == 0
    others = np.arange(20) != 7
    kept = packing.to_records(params[others], scales)
    np.testing.assert_array_equal(records[others], kept)
    found = packing.weights(params)
    assert np.isfinite(found).all() and (np.isfinite(value) or found[7] == 0)
    low, high = packing.scale_range(params[:0])
    assert low < high and len(packing.to_records(params[:0], (low, high))) == 0


START_NS, BEGIN_S = ORIGIN_NS - 3_500_000_000, 3.5  # the run began before the field's motion


def read(published: Published, instant_s: float):
    """What a visitor draws who has all of a publication."""
    static = published.static
    whole = messages.StaticBlock(1, len(static.records), 0, static.scales, static.records)
    moving = [block for block in (published.knots, published.moving) if block is not None]
    reader = messages.StreamReader()
    reader.read(messages.write_message(0, instant_s, [published.scene, whole, *moving]))
    return reader.at(instant_s)


def test_the_visitor_sees_what_the_edge_renders():
    shown = snapshot()
    published = Publisher(START_NS).take(shown, 0.0)
    assert published is not None
    for ahead_s in (-0.2, 0.0, 0.13, 0.5):
        wanted = shown.at(ORIGIN_NS + round((NEWEST_S + ahead_s) * 1e9))
        got = replace(shown, params=read(published, BEGIN_S + NEWEST_S + ahead_s))
        one, two = (each.render(POSE, LENS).color for each in (wanted, got))
        assert psnr(one, two) > 50.0 and one.std() > 0.1


def test_shares_of_anchors_that_are_rounded_up_exceed_no_whole():
    shown = snapshot()
    halves = np.tile(np.float32([0.5, 0.5, 0.0]), (len(shown.moving.share), 1))
    published = Publisher(START_NS).take(replace(shown, moving=replace(shown.moving, share=halves)), 0.0)
    np.testing.assert_array_equal(published.moving.share, [[128, 127]] * len(halves))


def test_a_set_is_the_same_one_while_the_field_trains_on():
    publisher, params = Publisher(0), gaussians(700, 0)
    first = publisher.take(snapshot(params), 0.0)
    trained = publisher.take(snapshot(params + np.float32(0.003)), 0.6)
    assert first.static.number == trained.static.number and trained.static is not first.static
    np.testing.assert_array_equal(np.sort(-first.static.weight), -first.static.weight)
    np.testing.assert_allclose(read(trained, 0.0)[:700, 11:], read(first, 0.0)[:700, 11:] + 0.003, atol=0.009)
    soon = publisher.take(snapshot(params), 0.7)
    assert soon.static is trained.static and soon.serial == trained.serial + 1  # not made anew so soon
    shuffled = publisher.take(snapshot(params[::-1].copy()), 2.0)
    fewer = publisher.take(snapshot(params[:600]), 4.0)
    assert [each.static.number for each in (trained, shuffled, fewer)] == [1, 2, 3]
    grown = snapshot(params[:650])
    growing = publisher.take(grown, 4.7)
    assert growing.static is fewer.static  # a new set a second at most
    assert publisher.take(grown, 4.9) is growing
    assert len(publisher.take(grown, 5.1).static.records) == 650  # also if nothing more is published


def test_a_still_field_and_one_without_gaussians():
    still = SplatSnapshot(BOX, gaussians(50, 0), np.zeros(3, np.float32), snapshot().pool, 0)
    published = Publisher(5).take(still, 0.0)
    assert (published.moving, published.knots) == (None, None)
    assert len(published.static.records) == 50
    assert Publisher(0).take(object(), 0.0) is None
    again = Publisher(0)
    assert again.take(still, 0.0) is again.take(still, 9.0)
    # Another box is another field.
    shown = (snapshot(), snapshot(movers=100), snapshot(box=replace(BOX, radius_m=3.0)))
    assert [again.take(each, 9.0).scene.field for each in shown] == [1, 1, 2]
