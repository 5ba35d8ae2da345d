"""Payloads: what goes in comes out, and hostile bytes are only ever refused."""

import contextlib
import struct
import zlib

import cv2
import numpy as np
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st

from freshfield.geometry import Pinhole
from freshfield.limits import MAX_IMAGE_SIDE_PX, MAX_PAYLOAD_BYTES
from freshfield.payload import CODECS, PayloadError, check, decode, encode
from tests.support import MOST_MS, refused, turned_jpeg, work_ms


@given(
    st.tuples(*[st.integers(1, 40)] * 2), st.integers(0, 2**32), st.sampled_from([("png", 3), ("png", 4), ("zstd", 3)])
)
def test_lossless_codecs_give_the_same_pixels(size, seed, how):
    """PNG with straight alpha, too."""
    codec, channels = how
    image = np.random.default_rng(seed).integers(0, 256, (size[1], size[0], channels), dtype=np.uint8)
    np.testing.assert_array_equal(decode(encode(image, codec), codec, *size), image)


def test_color_is_not_subsampled_from_quality_90_up():
    image = np.zeros((32, 32, 3), np.uint8)
    image[:, ::2] = (255, 0, 0)
    image[:, 1::2] = (0, 0, 255)  # columns of one luma range that 4:2:0 would mix
    error = {q: np.abs(decode(encode(image, "jpeg", q), "jpeg", 32, 32).astype(int) - image).mean() for q in (89, 90)}
    assert error[90] < 0.5 * error[89]


def test_a_gray_jpeg_or_png_comes_back_as_rgb():
    gray = np.random.default_rng(0).integers(0, 256, (16, 16), dtype=np.uint8)
    for codec, extension in (("jpeg", ".jpg"), ("png", ".png")):
        data = cv2.imencode(extension, gray)[1].tobytes()
        back = decode(data, codec, 16, 16)
        assert back.shape == (16, 16, 3) and np.ptp(back, axis=2).max() == 0


def test_what_cannot_be_sent_is_refused():
    side = MAX_IMAGE_SIDE_PX + 1
    for shape, dtype, codec, reason in (
        ((4, 4, 3), np.float32, "png", "bad_image"),
        ((4, 4), np.uint8, "png", "bad_image"),
        ((1, side, 3), np.uint8, "png", "too_large"),
        ((0, 4, 3), np.uint8, "zstd", "too_large"),
        ((4, 4, 3), np.uint8, "webp", "unknown_codec"),
    ):
        assert refused(PayloadError, "", encode, np.zeros(shape, dtype), codec).reason == reason


def chunk(name: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width: int, height: int, depth: int = 8, kind: int = 2, rows: bytes = bytes(1000), interlaced: int = 0):
    """A PNG with any header, well-formed or not."""
    header = struct.pack(">IIBBBBB", width, height, depth, kind, 0, 0, interlaced)
    parts = chunk(b"IHDR", header), chunk(b"IDAT", zlib.compress(rows)), chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def forge_jpeg(data: bytes, width: int, height: int) -> bytes:
    """The same JPEG with another size in its frame header."""
    at = data.index(b"\xff\xc0")
    return data[: at + 5] + struct.pack(">HH", height, width) + data[at + 9 :]


def claim(data: bytes, chunk: bytes, length: int) -> bytes:
    """The same PNG with another length in the header of a chunk."""
    at = data.index(chunk)
    return data[: at - 4] + struct.pack(">I", length) + data[at:]


PIXELS = np.random.default_rng(2).integers(0, 256, (48, 64, 3), dtype=np.uint8)
JPEG, PNG = encode(PIXELS, "jpeg"), encode(PIXELS, "png")
PROGRESSIVE = cv2.imencode(".jpg", np.zeros((48, 64, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
SCAN = PROGRESSIVE[PROGRESSIVE.rindex(b"\xff\xda") : -2]
FRAME_HEADER = bytes.fromhex("ffc0000b0800300040010111 00")  # a second one, 64 x 48, of one component
BOMB = zstandard.ZstdCompressor(level=19).compress(bytes(2**30))


@pytest.mark.parametrize(
    ("data", "codec", "size", "reason"),
    [
        (forge_jpeg(JPEG, 30000, 30000), "jpeg", (64, 48), "size_mismatch"),
        (png(30000, 30000), "png", (64, 48), "size_mismatch"),
        (png(30000, 30000), "png", (30000, 30000), "too_large"),
        (BOMB, "zstd", (64, 48), "size_mismatch"),
        (bytes(MAX_PAYLOAD_BYTES + 1), "jpeg", (64, 48), "too_large"),
        (JPEG, "png", (64, 48), "bad_payload"),
        (JPEG, "gif", (64, 48), "unknown_codec"),
        (b"", "jpeg", (64, 48), "bad_payload"),
        (JPEG[:3], "jpeg", (64, 48), "bad_payload"),
        # Two frame headers: decoders disagree on which one counts.
        (JPEG[:2] + FRAME_HEADER + JPEG[2:], "jpeg", (64, 48), "bad_payload"),
        # As many scans as there is room for: a decoder visits every block of the image in each.
        (PROGRESSIVE[:-2] + 7 * SCAN + PROGRESSIVE[-2:], "jpeg", (64, 48), "too_many_scans"),
        # Decoders make room for what a chunk claims to hold, and look at every chunk.
        (claim(PNG, b"IDAT", 2**31), "png", (64, 48), "bad_payload"),
        (claim(PNG, b"IEND", 2**32 - 1), "png", (64, 48), "bad_payload"),
        (PNG[:-1], "png", (64, 48), "bad_payload"),
        (PNG[:33] + 11_000 * (bytes(4) + b"tEXt" + bytes(4)) + PNG[33:], "png", (64, 48), "bad_payload"),
    ],
    ids=lambda v: v[:8].hex() if isinstance(v, bytes) else str(v),
)
def test_hostile_headers_are_refused_by_check_alone(data, codec, size, reason):
    assert refused(PayloadError, "", check, data, codec, *size).reason == reason
    refused(PayloadError, "", decode, data, codec, *size)


ROOM = MAX_PAYLOAD_BYTES - len(JPEG)


@pytest.mark.parametrize(
    "data",
    [
        JPEG[:2] + b"\xff" * ROOM + JPEG[2:],
        JPEG[:2] + b"\xff\xfe\0\x02" * (ROOM // 4) + JPEG[2:],
        JPEG[:-2] + b"\xff\xda" * (ROOM // 2) + JPEG[-2:],
    ],
    ids=["fill bytes", "empty comments", "scans"],
)
def test_eight_megabytes_do_not_keep_a_reader_busy(data):
    def read():
        with contextlib.suppress(PayloadError):
            check(data, "jpeg", 64, 48)

    assert work_ms(read) < MOST_MS


def test_a_progressive_jpeg_and_one_with_fill_bytes_are_welcome_and_exif_orientation_does_not_turn_pixels():
    assert decode(PROGRESSIVE, "jpeg", 64, 48).shape == (48, 64, 3)
    for data in (JPEG[:2] + b"\xff\xff" + JPEG[2:], turned_jpeg(JPEG, 6)):
        np.testing.assert_array_equal(decode(data, "jpeg", 64, 48), decode(JPEG, "jpeg", 64, 48))


def test_only_what_the_pixels_of_a_png_need_is_inflated():
    """Text of 1 GB is left alone, wherever it stands; image data beyond the image are refused once they begin."""
    text = chunk(b"zTXt", b"note\0\0" + zlib.compress(bytes(2**26))) * 16
    for data in (PNG[:33] + text + PNG[33:], PNG[:-12] + text + PNG[-12:]):
        np.testing.assert_array_equal(decode(data, "png", 64, 48), PIXELS)
        assert work_ms(lambda data=data: decode(data, "png", 64, 48)) < MOST_MS
    bomb = png(64, 48, rows=bytes(2**27))

    why = "more than 9264 bytes, not 9264"
    assert work_ms(lambda: refused(PayloadError, why, decode, bomb, "png", 64, 48)) < MOST_MS
    refused(PayloadError, r"of 9263 bytes, not 9264", decode, png(64, 48, rows=bytes(9263)), "png", 64, 48)


@pytest.mark.parametrize(("width", "height"), [(5, 3), (17, 25)])
def test_an_interlaced_png_is_decoded(width, height):
    """Gray: the seven passes of Adam7, written out."""
    image = (np.arange(width * height) * 17 % 256).astype(np.uint8).reshape(height, width)
    passes = [image[::8, ::8], image[::8, 4::8], image[4::8, ::4], image[::4, 2::4], image[2::4, ::2]]
    passes += [image[::2, 1::2], image[1::2]]
    rows = b"".join(b"\0" + row.tobytes() for each in passes if each.size for row in each)
    back = decode(png(width, height, 8, 0, rows, interlaced=1), "png", width, height)
    np.testing.assert_array_equal(back, np.repeat(image[..., None], 3, axis=2))
    with pytest.raises(PayloadError, match="more than"):
        decode(png(width, height, 8, 0, rows + b"\0", interlaced=1), "png", width, height)


def test_other_depths_never_come_back_as_something_else():
    """16-bit and palette PNGs are decoded to 8 bits a channel or refused, never passed on as they are."""
    for depth, kind in ((16, 2), (16, 0), (1, 0), (8, 4), (8, 3), (16, 6)):
        try:
            image = decode(png(8, 8, depth, kind, rows=b"\0" * 8 * 70), "png", 8, 8)
        except PayloadError as error:
            assert error.reason == "undecodable"
        else:
            assert image.dtype == np.uint8 and image.shape[2] in (3, 4)


@pytest.mark.parametrize("codec", CODECS)
@pytest.mark.parametrize("size", [(5, 7), (64, 48)])
def test_halving_keeps_the_picture(codec, size):
    width, height = size
    x, y = np.meshgrid(np.linspace(0, 200, width), np.linspace(0, 200, height))
    image = np.stack([x, y, x + y / 4], axis=-1).astype(np.uint8)
    data = encode(image, codec, 95)
    for halvings in range(4):
        small = decode(data, codec, width, height, halvings)
        n = 2**halvings
        assert small.shape == (-(-height // n), -(-width // n), 3)
        camera = Pinhole.from_fov(width, height, 60.0).halved(halvings)
        assert (camera.height, camera.width) == small.shape[:2]
        if width % n == height % n == 0:
            mean = image.reshape(height // n, n, width // n, n, 3).mean(axis=(1, 3))
            assert np.abs(small - mean).max() < 6


def test_halving_lets_no_color_of_transparent_pixels_bleed():
    image = np.zeros((6, 5, 4), np.uint8)
    image[:3, :3] = (220, 40, 90, 255)  # an edge within blocks of two
    image[4, 4] = (10, 200, 30, 128)
    small = decode(encode(image, "png"), "png", 5, 6, 1)
    assert np.array_equal(small[1, 1], (220, 40, 90, 64)) and np.array_equal(small[0, 1], (220, 40, 90, 128))
    assert np.array_equal(small[2, 2], (10, 200, 30, 64)) and not small[2, 0].any()
