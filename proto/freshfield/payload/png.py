"""The part of a PNG file that its pixels need, so that a decoder never inflates more than the image.

libpng inflates text and color profiles, and all of the image data however much there is: a PNG of 128 x 128
pixels with 900 zTXt chunks keeps it busy for 15 s, one whose IDAT chunks inflate to 8.6 GB for 11 s.
Chunks and filters: PNG specification, third edition, sections 5, 7.2 and 8.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

from freshfield.limits import MAX_PNG_CHUNKS

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_NEEDED = (b"IHDR", b"PLTE", b"tRNS", b"IDAT")
_END = b"\x00\x00\x00\x00IEND\xaeB`\x82"
# Channels of a pixel by color type: gray, RGB, palette, gray with alpha, RGBA.
_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
# Adam7: first column and row of each pass, and its steps.
_PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))


def png_size(data: bytes) -> tuple[int, int] | None:
    """Width and height in the header; None unless all chunks up to the last lie within the data."""
    if len(data) < 33 or data[:8] != _SIGNATURE or data[12:16] != b"IHDR":
        return None
    if not any(kind == b"IEND" for kind, _ in _chunks(data)):
        return None
    width, height = struct.unpack(">II", data[16:24])
    return int(width), int(height)


def pixels_only(data: bytes) -> bytes:
    """The PNG reduced to the chunks that its pixels need.

    data: a PNG that ``png_size`` accepts.
    Raises ValueError if the header names no PNG format, or the image data inflate to fewer or more bytes than the
    image has. Never inflates more than those.
    """
    depth, color, _, _, interlaced = data[24:29]
    if color not in _CHANNELS or depth not in (1, 2, 4, 8, 16) or interlaced > 1:
        raise ValueError(f"PNG color type {color} with {depth} bits, interlace {interlaced}")
    width, height = struct.unpack(">II", data[16:24])
    size = _raw_size(width, height, _CHANNELS[color] * depth, bool(interlaced))
    chunks = [(kind, chunk) for kind, chunk in _chunks(data) if kind in _NEEDED]
    found = _inflated_size([chunk[8:-4] for kind, chunk in chunks if kind == b"IDAT"], size)
    if found != size:
        raise ValueError(
            f"PNG image data of {'more than ' if found > size else ''}{min(found, size)} bytes, not {size}"
        )
    return b"".join((_SIGNATURE, *(chunk for _, chunk in chunks), _END))


def _chunks(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Type and bytes, from the length to the checksum, of each chunk up to the last, as far as they lie within
    ``data`` and within MAX_PNG_CHUNKS."""
    at = len(_SIGNATURE)
    for _ in range(MAX_PNG_CHUNKS):
        if at + 12 > len(data):
            return
        (length,) = struct.unpack_from(">I", data, at)
        end = at + 12 + length
        if end > len(data):
            return
        kind = data[at + 4 : at + 8]
        yield kind, data[at:end]
        if kind == b"IEND":
            return
        at = end


def _raw_size(width: int, height: int, bits: int, interlaced: bool) -> int:
    """Bytes of the filtered rows: one filter byte and the pixels, for each row of each pass that has pixels."""

    def rows(columns: int, lines: int) -> int:
        return lines * (1 + (columns * bits + 7) // 8) if columns > 0 else 0

    if not interlaced:
        return rows(width, height)
    return sum(rows(-(-(width - x) // dx), -(-(height - y) // dy)) for x, y, dx, dy in _PASSES)


def _inflated_size(parts: list[bytes], most: int) -> int:
    """Bytes that a zlib stream in ``parts`` inflates to, counted to ``most + 1``. A damaged stream counts up to
    where it is damaged."""
    inflate, size = zlib.decompressobj(), 0
    for part in parts:
        try:
            size += len(inflate.decompress(part, most + 1 - size))
        except zlib.error:
            return size
        if size > most or inflate.eof:
            return size
    return size
