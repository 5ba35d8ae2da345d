from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from edge_server.live.view_decoder import ViewDecoder
from freshfield import payload
from freshfield.depth import DepthImage
from tests.edge_server.frames import damaged_frame, frame


def test_a_frame_is_decoded_once_and_carries_the_edges_time():
    decoder = ViewDecoder()
    item = frame(generated_ns=5, clock_offset_ns=7, received_ns=20)
    (first,) = decoder.views([item])
    (second,) = decoder.views([item])
    assert first is second
    assert first.generated_ns == 12
    assert first.image.shape == (24, 32, 3)
    assert np.allclose(first.camera_to_world, item.pose.matrix())


def test_a_damaged_payload_is_counted_once_and_loses_nothing_else():
    decoder = ViewDecoder()
    items = [damaged_frame("cam01"), frame("cam02")]
    assert [v.camera for v in decoder.views(items)] == ["cam02"]
    assert [v.camera for v in decoder.views(items)] == ["cam02"]
    assert decoder.undecodable == 1


def test_a_large_image_is_decoded_smaller_and_whole_when_asked_for():
    item = frame()  # 32 x 24
    for most, size in ((768, (24, 32)), (767, (12, 16)), (1, (3, 4))):
        view = ViewDecoder(most_pixels=most).view(item)
        assert view.image.shape[:2] == size == (view.intrinsics.height, view.intrinsics.width)
        if size == (24, 32):
            assert view.whole is None
            continue
        whole = view.whole()
        assert whole.image.shape[:2] == (24, 32) and whole.whole is None
        np.testing.assert_allclose(
            view.intrinsics.rays([[1.0, 2.0]]), whole.intrinsics.rays([[32 / size[1], 2.0 * 24 / size[0]]])
        )


def test_depth_comes_with_its_view_and_with_its_own_time():
    counts = np.arange(24 * 32, dtype=np.uint16).reshape(24, 32)
    sent = DepthImage(counts, 0.002, after_image_ns=-30).encode()
    item = frame(generated_ns=100, clock_offset_ns=7, depth=sent)
    view = ViewDecoder().view(item)
    np.testing.assert_array_equal(view.depth, counts * np.float32(0.002))
    assert view.depth.dtype == np.float32 and (view.generated_ns, view.depth_ns) == (107, 77)
    small = ViewDecoder(most_pixels=200).view(item)
    assert small.depth.shape == small.image.shape[:2] == (12, 16)
    np.testing.assert_array_equal(small.whole().depth, view.depth)
    plain = ViewDecoder().view(frame())
    assert plain.depth is None and plain.depth_ns is None


@pytest.mark.stability
def test_damaged_depth_costs_the_depth_and_not_the_image():
    sent = DepthImage(np.random.default_rng(0).integers(0, 9000, (24, 32), np.uint16), 0.001).encode()
    cut = replace(sent, payload=sent.payload[: len(sent.payload) // 2])
    cut.check(frame().intrinsics, 1)  # it passes at the door
    decoder = ViewDecoder(most_pixels=200)
    for _ in range(2):
        (view,) = decoder.views([item := frame(depth=cut)])
        decoder.views([item])
        assert view.image.shape == (12, 16, 3) and view.depth is None and view.whole().depth is None
    assert (decoder.undecodable, decoder.undecodable_depth) == (0, 2)
    assert decoder.view(damaged_frame(depth=sent)) is None
    assert (decoder.undecodable, decoder.undecodable_depth) == (1, 2)


def test_a_damaged_png_writes_nothing_to_the_log(capfd):
    """libpng would, at each decode."""
    whole = payload.encode(np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8), "png")
    for k in range(40, len(whole) - 4, 97):
        for data in (whole[:k], whole[:k] + b"\xff\xd0\x00\x11" + whole[k + 4 :], whole[:k] + whole[k + 1 :]):
            assert ViewDecoder().views([frame(codec="png", payload=data)]) == []
    assert capfd.readouterr() == ("", "")
