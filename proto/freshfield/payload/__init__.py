"""Encode images into payloads and decode them again.

The limits are checked on headers *before* anything is decompressed: a 109 kB PNG can claim 2.7 GB of pixels,
OpenCV allocates as many bytes as a PNG's chunk claims (one flipped bit: 4 GB, 5 s), and the zstandard decoder
ignores ``max_output_size`` for a frame that declares its size.

Only encoding and decoding import OpenCV: the emulator only checks headers and runs without it.
"""

from __future__ import annotations

import os
import struct
from typing import Literal

import numpy as np
import zstandard
from numpy.typing import NDArray

from freshfield.limits import MAX_IMAGE_SIDE_PX, MAX_JPEG_SCANS, MAX_JPEG_SEGMENTS, MAX_PAYLOAD_BYTES
from freshfield.payload.png import pixels_only, png_size

# OpenCV reads this when it is first imported: a second barrier behind the header checks below.
os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_IMAGE_SIDE_PX**2))

CODECS = ("jpeg", "png", "zstd")
DEFAULT_CODEC: Literal["jpeg"] = "jpeg"
"""Of a scenario that names none: what most cameras send."""


class PayloadError(ValueError):
    """A payload that is refused. reason: short name, for the counts; the message is for people."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


def encode(image: NDArray[np.uint8], codec: str = "jpeg", quality: int = 92) -> bytes:
    """Compress an image.

    image: uint8 RGB (H, W, 3) or RGBA (H, W, 4).
    codec: ``jpeg`` (RGB), ``png`` (lossless, keeps alpha) or ``zstd`` (raw RGB, lossless).
    quality: of jpeg, 1 to 100; from 90 up without chroma subsampling.
    Raises PayloadError for an image, size or codec that cannot be sent.
    """
    import cv2

    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] not in (3, 4):
        raise PayloadError("bad_image", f"expected uint8 (H, W, 3 or 4), got {image.dtype} {image.shape}")
    if max(image.shape[:2]) > MAX_IMAGE_SIDE_PX or min(image.shape[:2]) < 1:
        raise PayloadError("too_large", f"{image.shape[1]} x {image.shape[0]} exceeds {MAX_IMAGE_SIDE_PX} a side")
    if codec == "zstd":
        return zstandard.ZstdCompressor(level=1).compress(np.ascontiguousarray(image[..., :3]).tobytes())
    if codec == "jpeg":
        sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444 if quality >= 90 else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
        flags = [cv2.IMWRITE_JPEG_QUALITY, int(quality), cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
        ok, data = cv2.imencode(".jpg", cv2.cvtColor(image[..., :3], cv2.COLOR_RGB2BGR), flags)
    elif codec == "png":
        order = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
        ok, data = cv2.imencode(".png", cv2.cvtColor(image, order), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    else:
        raise PayloadError("unknown_codec", f"codec {codec!r} is not one of {', '.join(CODECS)}")
    if not ok:
        raise PayloadError("bad_image", f"OpenCV could not encode a {codec} of {image.shape}")
    return data.tobytes()


def check(payload: bytes, codec: str, width: int, height: int) -> None:
    """Refuse a payload that must not be decoded, by its headers only. Takes microseconds, for the largest
    payload some milliseconds.

    Raises PayloadError: ``too_large``, ``unknown_codec``, ``bad_payload`` (not this format, a PNG that ends
    early, or a JPEG of too many segments), ``too_many_scans`` (of a JPEG), or ``size_mismatch`` (the image is
    not width x height as announced).
    """
    if len(payload) > MAX_PAYLOAD_BYTES:
        raise PayloadError("too_large", f"payload of {len(payload)} bytes exceeds {MAX_PAYLOAD_BYTES}")
    if not (0 < width <= MAX_IMAGE_SIDE_PX and 0 < height <= MAX_IMAGE_SIDE_PX):
        raise PayloadError("too_large", f"{width} x {height} is not within 1..{MAX_IMAGE_SIDE_PX} a side")
    if codec == "zstd":
        if (declared := declared_bytes(payload)) != width * height * 3:
            raise PayloadError("size_mismatch", f"zstd declares {declared} bytes, not {width} x {height} x 3")
        return
    if codec == "jpeg":
        found = jpeg_size(payload)
    elif codec == "png":
        found = png_size(payload)
    else:
        raise PayloadError("unknown_codec", f"codec {codec!r} is not one of {', '.join(CODECS)}")
    if found is None:
        raise PayloadError("bad_payload", f"{len(payload)} bytes without the headers of a {codec}")
    if found != (width, height):
        raise PayloadError("size_mismatch", f"image is {found[0]} x {found[1]}, announced {width} x {height}")
    if codec == "jpeg" and (scans := _jpeg_scans(payload)) > MAX_JPEG_SCANS:
        raise PayloadError("too_many_scans", f"a JPEG of {scans} scans, more than {MAX_JPEG_SCANS}")


def decode(payload: bytes, codec: str, width: int, height: int, halvings: int = 0) -> NDArray[np.uint8]:
    """Check a payload (``check``) and decode it to uint8 RGB (H, W, 3) or RGBA (H, W, 4).

    width, height: announced size, before halving.
    halvings: 0 to 3, how often both sides are halved and rounded up; an odd side repeats its last row or
        column. A JPEG is decoded directly to the smaller size, which is faster.
    Raises PayloadError with a reason of ``check``, or ``undecodable`` for damaged data.
    """
    import cv2

    check(payload, codec, width, height)
    if codec == "zstd":
        raw = inflate(payload, width * height * 3)
        return _halved(np.frombuffer(raw, np.uint8).reshape(height, width, 3), halvings)
    flags = cv2.IMREAD_UNCHANGED
    if codec == "png":
        try:
            payload = pixels_only(payload)
        except ValueError as error:
            raise PayloadError("undecodable", str(error)) from None
    if codec == "jpeg":
        reduced = (cv2.IMREAD_COLOR, cv2.IMREAD_REDUCED_COLOR_2, cv2.IMREAD_REDUCED_COLOR_4, cv2.IMREAD_REDUCED_COLOR_8)
        flags = reduced[halvings] | cv2.IMREAD_IGNORE_ORIENTATION
        width, height, halvings = -(-width >> halvings), -(-height >> halvings), 0
    try:
        image = cv2.imdecode(np.frombuffer(payload, np.uint8), flags)
    except cv2.error as error:
        raise PayloadError("undecodable", f"OpenCV: {error}") from None
    if image is None or image.dtype != np.uint8 or image.shape[:2] != (height, width):
        raise PayloadError("undecodable", f"the {codec} data is damaged")
    if image.ndim == 2:
        order = cv2.COLOR_GRAY2RGB
    else:
        order = cv2.COLOR_BGRA2RGBA if image.shape[2] == 4 else cv2.COLOR_BGR2RGB
    return _halved(np.asarray(cv2.cvtColor(image, order), dtype=np.uint8), halvings)


def declared_bytes(payload: bytes) -> int:
    """Size that a zstandard frame declares. Raises PayloadError ``bad_payload`` if it is none."""
    try:
        return int(zstandard.get_frame_parameters(payload).content_size)
    except zstandard.ZstdError as error:
        raise PayloadError("bad_payload", f"not a zstandard frame: {error}") from None


def inflate(payload: bytes, size: int) -> bytes:
    """Decompress a zstandard frame that declares ``size`` bytes. Raises PayloadError ``undecodable``."""
    try:
        raw = zstandard.ZstdDecompressor().decompress(payload, max_output_size=size)
    except zstandard.ZstdError as error:
        raise PayloadError("undecodable", f"zstandard: {error}") from None
    if len(raw) != size:
        raise PayloadError("undecodable", f"zstandard gave {len(raw)} bytes")
    return raw


def _halved(image: NDArray[np.uint8], halvings: int) -> NDArray[np.uint8]:
    import cv2

    for _ in range(halvings):
        bottom, right = image.shape[0] % 2, image.shape[1] % 2
        even = cv2.copyMakeBorder(image, 0, bottom, 0, right, cv2.BORDER_REPLICATE)
        half = even.shape[1] // 2, even.shape[0] // 2
        small = np.asarray(cv2.resize(even, half, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        if image.shape[2] == 4:  # straight alpha: colors are averaged with alpha as their weight
            blocks = even.reshape(small.shape[0], 2, small.shape[1], 2, 4).astype(np.float32)
            alpha = blocks[..., 3:]
            seen = (blocks[..., :3] * alpha).sum(axis=(1, 3)) / np.maximum(alpha.sum(axis=(1, 3)), 1.0)
            small[..., :3] = np.rint(seen)
        image = small
    return image


def _jpeg_scans(data: bytes) -> int:
    """Number of start-of-scan markers, which cannot occur as data within a scan; a thumbnail in a header adds
    its own. Counted as 16-bit words in both alignments: ``bytes.count`` takes 35 ms for 8 MB of 0xFF."""
    words = (np.frombuffer(data, "<u2", (len(data) - start) // 2, start) for start in (0, 1))
    return sum(int(np.count_nonzero(part == 0xDAFF)) for part in words)


def jpeg_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the start-of-frame segment; None unless exactly one precedes the first scan."""
    if data[:2] != b"\xff\xd8":
        return None
    at, size = 2, None
    for _ in range(MAX_JPEG_SEGMENTS):
        if at + 4 > len(data) or data[at] != 0xFF:
            return None
        marker = data[at + 1]
        if marker == 0xFF:  # fill byte
            at += 1
            continue
        if marker == 0xDA:  # start of scan: no more headers
            return size
        (length,) = struct.unpack(">H", data[at + 2 : at + 4])
        if length < 2:
            return None
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            if size is not None or at + 9 > len(data):
                return None  # two frame headers: decoders disagree on which one counts
            height, width = struct.unpack(">HH", data[at + 5 : at + 9])
            size = (int(width), int(height))
        at += 2 + length
    return None
