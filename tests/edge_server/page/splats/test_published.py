"""What the field publishes, as records: the same picture, sets that stay the same while the field trains on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from edge_server.fields.splat.kernels.project import Gaussians
from edge_server.fields.splat.snapshot import SplatSnapshot
from edge_server.page.splats.messages import StaticBlock, StreamReader, write_message
from edge_server.page.splats.published import Published, Publisher
from tests.edge_server.fields.scenes import psnr
from tests.edge_server.page.splats.gaussians import BOX, LENS, NEWEST_S, ORIGIN_NS, POSE, gaussians, snapshot

START_NS, BEGIN_S = ORIGIN_NS - 3_500_000_000, 3.5  # the run began before the field's motion


def read(published: Published, instant_s: float):
    """What a visitor draws who has all of a publication."""
    static = published.static
    whole = StaticBlock(1, len(static.records), 0, static.scales, static.records)
    moving = [block for block in (published.knots, published.moving) if block is not None]
    reader = StreamReader()
    reader.read(write_message(0, instant_s, [published.scene, whole, *moving]))
    return reader.at(instant_s)


def test_the_visitor_sees_what_the_edge_renders():
    shown = snapshot()
    published = Publisher(START_NS).take(shown, 0.0)
    assert published is not None
    for ahead_s in (-0.2, 0.0, 0.13, 0.5):
        wanted = shown.at(ORIGIN_NS + round((NEWEST_S + ahead_s) * 1e9))
        got = replace(shown, gaussians=Gaussians(read(published, BEGIN_S + NEWEST_S + ahead_s), 0))
        one, two = (each.render(POSE, LENS).color for each in (wanted, got))
        assert psnr(one, two) > 50.0 and one.std() > 0.1


def test_a_set_is_the_same_one_while_the_field_trains_on():
    publisher, params = Publisher(0), gaussians(700, 0)
    first = publisher.take(snapshot(params), 0.0)
    trained = publisher.take(snapshot(params + np.float32(0.003)), 0.6)
    assert first.static.number == trained.static.number and trained.static.version > first.static.version
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
    still = SplatSnapshot(BOX, Gaussians(gaussians(50, 0), 0), np.zeros(3, np.float32), snapshot().pool, 0)
    published = Publisher(5).take(still, 0.0)
    assert (published.moving, published.knots) == (None, None)
    assert len(published.static.records) == 50
    assert Publisher(0).take(object(), 0.0) is None
    again = Publisher(0)
    assert again.take(still, 0.0) is again.take(still, 9.0)
    # Another box is another field.
    shown = (snapshot(), snapshot(movers=100), snapshot(box=replace(BOX, radius_m=3.0)))
    assert [again.take(each, 9.0).scene.field for each in shown] == [1, 1, 2]
