"""Frames are embedded when a decision uses them, once, and one bad frame costs only its own camera."""

from __future__ import annotations

import numpy as np

from edge_server.embed.cache import EmbeddingCache
from edge_server.live.view_decoder import ViewDecoder
from freshfield.frame import Frame
from tests.edge_server.frames import damaged_frame, frame

DIM = 4


class Means:
    """Embeds a picture as its mean colors, and notes what it was asked for."""

    dim = DIM

    def __init__(self) -> None:
        self.asked: list[int] = []

    def embed(self, images):
        self.asked.append(len(images))
        return np.array([[*i.reshape(-1, 3).mean(0), 1.0] for i in images], np.float32)


def cached(**more) -> tuple[Means, EmbeddingCache]:
    means = Means()
    return means, EmbeddingCache(means, ViewDecoder().view, **more)


def buffered(camera: str = "cam01", sequence: int = 0, **other) -> Frame:
    return frame(camera, sequence, **{"generated_ns": sequence, "received_ns": sequence, **other})


def test_a_frame_is_embedded_once_whoever_asks_again():
    means, cache = cached()
    items = [buffered("cam01"), buffered("cam02", 3)]
    first, ok = cache.of(items)
    again, _ = cache.of(list(reversed(items)))
    assert ok.tolist() == [True, True] and first.dtype == np.float32 and first.shape == (2, DIM)
    assert (again == first[::-1]).all()
    assert means.asked == [2] and cache.computed == 2
    cache.of([*items, buffered("cam01", 1)])
    assert means.asked == [2, 1], "only what is new"
    cache.of([buffered("cam01", 1, session="s2")])
    assert means.asked == [2, 1, 1], "another session with the same number is another frame"


def test_a_frame_that_cannot_be_decoded_is_a_camera_without_embedding():
    means, decoder = Means(), ViewDecoder()
    cache = EmbeddingCache(means, decoder.view)
    for _ in range(3):
        rows, ok = cache.of([damaged_frame("cam01"), buffered("cam02")])
        assert ok.tolist() == [False, True] and (rows[0] == 0).all()
    assert cache.failed == 1 and decoder.undecodable == 1 and means.asked == [1]


def test_memory_is_bounded_and_the_latest_used_stay():
    means, cache = cached(capacity=4)
    kept = buffered("cam02")
    for k in range(20):
        cache.of([buffered("cam01", k), kept])
    assert len(cache._rows) == 4
    assert sum(means.asked) == 21, "the frame that every decision used was embedded once"
    rows, ok = cache.of([buffered(f"cam{k:02d}") for k in range(9)])
    assert ok.all() and len(rows) == 9 and len(cache._rows) == 4, "a larger decision is answered whole"
