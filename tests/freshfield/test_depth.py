"""Depth in a payload: what goes in comes out, small; hostile bytes are only ever refused."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from freshfield.depth import DepthImage, EncodedDepth
from freshfield.geometry import Pinhole, Pose
from freshfield.limits import MAX_DEPTH_GAP_NS, MAX_IMAGE_SIDE_PX, MAX_PAYLOAD_BYTES, METERS_PER_COUNT
from freshfield.payload import PayloadError
from tests.support import MOST_MS, refused, work_ms

LENS = Pinhole.from_fov(40, 30, 60.0)


def image(counts, **other) -> DepthImage:
    return DepthImage(np.asarray(counts, np.uint16), 0.001, **other)


def steps(width: int = 40, height: int = 30, seed: int = 0) -> np.ndarray:
    """Millimeters of a stereo sensor: a slope, in steps of disparity, with holes."""
    rng = np.random.default_rng(seed)
    disparity = np.linspace(6.0, 20.0, width) + rng.normal(0, 0.1, (height, width))
    z = np.round(1000 * 21.25 / (np.round(32 * disparity) / 32))
    return np.where(rng.random((height, width)) < 0.1, 0, z).astype(np.uint16)


@given(
    size=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    seed=st.integers(0, 2**32),
    most=st.sampled_from([0, 1, 3, 40, 5000, 2**16 - 1]),
    holes=st.sampled_from([0.0, 0.5, 1.0]),
)
def test_it_is_lossless(size, seed, most, holes):
    rng = np.random.default_rng(seed)
    counts = np.where(rng.random(size) < holes, 0, rng.integers(0, most + 1, size))
    lens, pose = replace(LENS, width=size[1], height=size[0]), Pose((1.0, 0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
    sent = image(counts, intrinsics=lens, to_camera=pose, after_image_ns=-7).encode()
    sent.check(lens, 0)
    back = sent.decode()
    assert back.counts.dtype == np.uint16 and back.meters_per_count == 0.001
    assert (back.intrinsics, back.to_camera, back.after_image_ns) == (lens, pose, -7)
    np.testing.assert_array_equal(back.counts, counts)


@pytest.mark.stability
def test_extreme_counts_come_back():
    """The largest differences of either sign, and every count, which leaves no room for a table."""
    for counts in (np.tile([1, 32768, 65535, 0], (30, 10)), np.arange(65536).reshape(256, 256)):
        np.testing.assert_array_equal(image(counts).encode().decode().counts, counts)


def test_steps_of_disparity_take_half_the_bytes_of_a_png():
    counts = steps(640, 480)
    assert len(image(counts).encode().payload) < 0.5 * len(cv2.imencode(".png", counts)[1])


def test_other_arrays_are_no_depth():
    for bad in (np.zeros((4, 4), np.int32), np.zeros((4, 4, 1), np.uint16), np.zeros((0, 4), "u2")):
        refused(PayloadError, r"expected uint16 \(H, W\)", DepthImage(bad, 0.001).encode)
    refused(PayloadError, "with a lens of", image(np.zeros((4, 4)), intrinsics=LENS).encode)


def zstd(size: int, value: bytes = b"\0") -> bytes:
    return zstandard.ZstdCompressor(level=1).compress(value * size)


GOOD = image(steps()).encode()
UNDECLARED = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(2400))
REFUSED = {
    "a bomb": (replace(GOOD, payload=zstd(2**28)), "size_mismatch"),
    "too few bytes": (replace(GOOD, payload=zstd(2 * 1200 - 2)), "size_mismatch"),
    "too long a table": (replace(GOOD, payload=zstd(2 * (1200 + 76))), "size_mismatch"),
    "no size declared": (replace(GOOD, payload=UNDECLARED), "size_mismatch"),
    "no zstandard": (replace(GOOD, payload=b"not depth"), "bad_payload"),
    "other sides": (replace(GOOD, width=30, height=40), "size_mismatch"),
    "a long side": (replace(GOOD, height=MAX_IMAGE_SIDE_PX + 1), "too_large"),
    "more bytes than a frame may have": (replace(GOOD, payload=bytes(MAX_PAYLOAD_BYTES)), "too_large"),
    "no scale": (replace(GOOD, meters_per_count=0.0), "bad_header"),
    "a scale of NaN": (replace(GOOD, meters_per_count=math.nan), "bad_header"),
    "kilometers": (replace(GOOD, meters_per_count=1000.0), "bad_header"),
    "of another time": (replace(GOOD, after_image_ns=MAX_DEPTH_GAP_NS + 1), "bad_header"),
    "a pose without a lens": (replace(GOOD, to_camera=Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))), "bad_header"),
}


@pytest.mark.stability
@pytest.mark.parametrize("kind", REFUSED)
def test_what_must_not_be_decoded_is_refused_by_name(kind):
    depth, reason = REFUSED[kind]
    error = refused(PayloadError, ".", depth.check, LENS, 1)
    assert error.reason == reason and work_ms(lambda: refused(PayloadError, "", depth.check, LENS, 1)) < MOST_MS


def test_the_bounds_themselves_are_within():
    for scale in METERS_PER_COUNT:
        replace(GOOD, meters_per_count=scale).check(LENS, 1)
    for gap_ns in (-MAX_DEPTH_GAP_NS, MAX_DEPTH_GAP_NS):
        replace(GOOD, after_image_ns=gap_ns).check(LENS, 1)


def test_registered_depth_may_be_smaller_but_not_of_another_shape():
    for width, height in ((40, 30), (20, 15), (81, 61)):
        GOOD.check(Pinhole.from_fov(width, height, 60.0), 1)
    for size in ((4096, 1), (1, 4096)):
        image(np.ones(size)).encode().check(replace(LENS, width=size[1], height=size[0]), 0)
    refused(PayloadError, "40 x 30, its image 40 x 40", GOOD.check, Pinhole.from_fov(40, 40, 60.0), 1)
    replace(GOOD, intrinsics=LENS).check(Pinhole.from_fov(40, 40, 60.0), 1)  # of a lens of its own


def packed(*words: int, side: int = 4) -> EncodedDepth:
    """A payload of given words and zeros: a table, then the pixels of a square."""
    planes = np.array(words, "<u2").view(np.uint8).reshape(-1, 2).T.tobytes()
    return EncodedDepth(zstandard.ZstdCompressor().compress(planes), side, side, 0.001)


@pytest.mark.stability
@pytest.mark.parametrize(
    "depth",
    [packed(5, 1, 1, 1, 3, *[0] * 12), packed(5, 65535, *[1] * 15), packed(65535, 1, *[1] * 36, side=6)],
    ids=["beyond the table", "far beyond the table", "a table beyond 16 bits"],
)
def test_counts_outside_the_table_are_undecodable(depth):
    depth.check(Pinhole.from_fov(depth.width, depth.height, 60.0), 1)
    assert refused(PayloadError, "", depth.decode).reason == "undecodable"
