from __future__ import annotations

import numpy as np

from edge_server.live.view_decoder import ViewDecoder
from freshfield import payload
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


def test_memory_is_one_view_a_camera():
    decoder = ViewDecoder()
    for i in range(200):
        decoder.views([frame(sequence=i, generated_ns=i, received_ns=i)])
    assert len(decoder._views) == 1


def test_another_size_is_decoded_anew():
    decoder, item = ViewDecoder(), frame()
    assert decoder.view(item).image.shape == (24, 32, 3)
    decoder.take_at_most(767)
    assert decoder.view(item).image.shape == (12, 16, 3)


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


def test_a_damaged_png_writes_nothing_to_the_log(capfd):
    """libpng would, at each decode."""
    whole = payload.encode(np.random.default_rng(0).integers(0, 255, (24, 32, 3), np.uint8), "png")
    for k in range(40, len(whole) - 4, 97):
        for data in (whole[:k], whole[:k] + b"\xff\xd0\x00\x11" + whole[k + 4 :], whole[:k] + whole[k + 1 :]):
            assert ViewDecoder().views([frame(codec="png", payload=data)]) == []
    assert capfd.readouterr() == ("", "")
