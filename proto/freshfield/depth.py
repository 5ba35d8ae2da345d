"""A depth image and its encoding on the wire.

The encoding is lossless. Sensors quantize disparity, so an image often has few distinct counts. If so, a sorted
table of them precedes the pixels, which become indices into it (for simulated stereo of 128 x 128 this halves the
size). Valid pixels are then replaced by the difference to the previous valid one, low and high bytes are separated,
and zstandard compresses both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import zstandard
from numpy.typing import NDArray

from freshfield.geometry import Pinhole, Pose
from freshfield.limits import MAX_DEPTH_GAP_NS, MAX_IMAGE_SIDE_PX, MAX_PAYLOAD_BYTES, METERS_PER_COUNT
from freshfield.payload import PayloadError, declared_bytes, inflate

_COUNTS = 2**16 - 1
"""Number of valid counts; differences are taken modulo it, which reserves symbol 0 for holes."""
_TABLE_PIXELS = 16
"""Fewest pixels per table entry: exact depth has more distinct counts, and a table would add 15 % to its size."""
_ZSTD_LEVEL = 3
"""For 640 x 480, level 1 saves .7 ms and takes up to 9 % more bytes; level 9 takes 9 ms more and saves 6 %."""


@dataclass(frozen=True)
class EncodedDepth:
    """Encoded depth of a frame. payload: from ``DepthImage.encode``. The other fields are as in ``DepthImage``."""

    payload: bytes
    width: int
    height: int
    meters_per_count: float
    intrinsics: Pinhole | None = None
    to_camera: Pose | None = None
    after_image_ns: int = 0

    def check(self, image: Pinhole, image_bytes: int) -> None:
        """Refuse depth that must not be decoded or cannot belong to its image; takes microseconds.

        image: intrinsics of the frame's image. image_bytes: size of its payload.
        Raises PayloadError: ``too_large``, ``bad_payload``, ``size_mismatch`` (other than announced, or registered
        to an image of another shape) or ``bad_header`` (scale, capture time).
        """
        if image_bytes + len(self.payload) > MAX_PAYLOAD_BYTES:
            raise PayloadError("too_large", f"{len(self.payload)} bytes and its image exceed {MAX_PAYLOAD_BYTES}")
        if not (0 < self.width <= MAX_IMAGE_SIDE_PX and 0 < self.height <= MAX_IMAGE_SIDE_PX):
            raise PayloadError("too_large", f"{self.width} x {self.height} is not within 1..{MAX_IMAGE_SIDE_PX} a side")
        least, most = METERS_PER_COUNT
        if not least <= self.meters_per_count <= most:  # nor is NaN
            raise PayloadError("bad_header", f"{self.meters_per_count:g} m a count is not within {least:g}..{most:g}")
        if abs(self.after_image_ns) > MAX_DEPTH_GAP_NS:
            raise PayloadError("bad_header", f"measured {self.after_image_ns / 1e9:g} s after its image")
        if self.intrinsics is None:
            if self.to_camera is not None:
                raise PayloadError("bad_header", "a pose of its own needs intrinsics of its own")
            if abs(self.width * image.height - self.height * image.width) > max(image.width, image.height):
                shapes = f"{self.width} x {self.height}, its image {image.width} x {image.height}"
                raise PayloadError("size_mismatch", f"registered to an image of another shape: {shapes}")
        pixels = self.width * self.height
        table = declared_bytes(self.payload) - 2 * pixels
        if not 0 <= table * _TABLE_PIXELS <= 2 * pixels or table % 2:
            raise PayloadError("size_mismatch", f"zstd does not declare the bytes of {self.width} x {self.height}")

    def decode(self) -> DepthImage:
        """Decode a payload that passed ``check``. Raises PayloadError ``undecodable`` for damaged data."""
        size = declared_bytes(self.payload)
        low, high = np.frombuffer(inflate(self.payload, size), np.uint8).reshape(2, -1)
        words = low | high.astype(np.uint16) << 8
        entries = len(words) - self.width * self.height
        symbols = words[entries:]
        measured = symbols > 0
        zigzag = symbols[measured].astype(np.int64) - 1
        found = np.cumsum(zigzag >> 1 ^ -(zigzag & 1)) % _COUNTS + 1
        if entries:
            table = np.cumsum(words[:entries], dtype=np.int64)
            if table[-1] > _COUNTS or found.max(initial=0) > entries:
                raise PayloadError("undecodable", "counts that are not in the table")
            found = table[found - 1]
        counts = np.zeros(len(symbols), np.uint16)
        counts[measured] = found
        shaped = counts.reshape(self.height, self.width)
        return DepthImage(shaped, self.meters_per_count, self.intrinsics, self.to_camera, self.after_image_ns)


@dataclass(frozen=True)
class DepthImage:
    """Depth along the optical axis, measured with (and usually at the instant of) an image.

    counts: uint16 (H, W), depth in counts; 0 where nothing was measured.
    meters_per_count: .001 if counts are millimeters.
    intrinsics: of the depth sensor, for H x W pixels. None: depth is registered to the image and has its
        intrinsics, scaled to H x W.
    to_camera: pose of the depth sensor in the image camera's axes; None: the two coincide.
    after_image_ns: capture time of the depth minus that of the image; negative if measured earlier.
    """

    counts: NDArray[np.uint16]
    meters_per_count: float
    intrinsics: Pinhole | None = None
    to_camera: Pose | None = None
    after_image_ns: int = 0

    def meters(self) -> NDArray[np.float32]:
        """Depth in meters, float32 (H, W); 0 where nothing was measured."""
        return self.counts * np.float32(self.meters_per_count)

    def encode(self) -> EncodedDepth:
        """Compress the image. Raises PayloadError ``bad_image`` for an array of another shape or type."""
        counts, k = self.counts, self.intrinsics
        if counts.dtype != np.uint16 or counts.ndim != 2 or not counts.size:
            raise PayloadError("bad_image", f"depth: expected uint16 (H, W), got {counts.dtype} {counts.shape}")
        height, width = counts.shape
        if k is not None and (k.width, k.height) != (width, height):
            raise PayloadError("bad_image", f"depth of {width} x {height} with a lens of {k.width} x {k.height}")
        present = np.zeros(_COUNTS + 1, bool)
        present[counts] = True
        present[0] = False
        table, places = np.flatnonzero(present), counts.ravel()
        if len(table) * _TABLE_PIXELS <= counts.size:
            places = np.cumsum(present)[places]
        else:
            table = table[:0]
        measured = places > 0
        steps = np.diff(places[measured].astype(np.int64) - 1, prepend=0)
        steps = (steps + _COUNTS // 2) % _COUNTS - _COUNTS // 2
        words = np.zeros(len(table) + counts.size, "<u2")
        words[: len(table)] = np.diff(table, prepend=0)
        words[len(table) :][measured] = (steps << 1 ^ steps >> 63) + 1
        planes = words.view(np.uint8).reshape(-1, 2).T.tobytes()
        payload = zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(planes)
        return EncodedDepth(payload, width, height, self.meters_per_count, k, self.to_camera, self.after_image_ns)
