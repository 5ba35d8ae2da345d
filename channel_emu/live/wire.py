"""Reads a PushRequest's header without touching its payload, and flips bytes of the payload for a fault."""

from __future__ import annotations

from channel_emu.live.live_link import Flips
from freshfield.v1 import frames_pb2 as pb

_HEADER = 1 << 3 | 2  # field 1, length-delimited
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


class WireError(ValueError):
    """Bytes that are not a PushRequest."""


def header_of(raw: bytes) -> pb.FrameHeader:
    """The header of a serialized PushRequest; the payload is skipped, not copied. Raises WireError."""
    view = memoryview(raw)
    header: memoryview | None = None
    at = 0
    while at < len(raw):
        tag, at = _varint(raw, at)
        kind = tag & 7
        if kind == _BYTES:
            size, at = _varint(raw, at)
            if tag == _HEADER:
                if header is not None:  # protobuf would merge them, and who sent the frame would be unclear
                    raise WireError("not a PushRequest: it has two headers")
                header = view[at : at + size]
            at += size
        elif kind == _VARINT:
            _, at = _varint(raw, at)
        elif kind in (_FIXED32, _FIXED64):
            at += 4 if kind == _FIXED32 else 8
        else:
            raise WireError("not a PushRequest: a field of an unknown kind")
    if at != len(raw) or header is None:
        raise WireError("not a PushRequest: it is cut off, or has no header")
    try:
        return pb.FrameHeader.FromString(bytes(header))
    except Exception as error:  # protobuf's DecodeError, whichever implementation is loaded
        raise WireError(f"not a PushRequest: {error}") from None


def damage_payload(raw: bytes, flips: Flips) -> bytes:
    """The message with bytes of its payload flipped. The checksum stays the sender's: so the edge notices."""
    from channel_emu.model.faults.corruption import damage  # only where a scenario lists it

    request = pb.PushRequest.FromString(raw)
    request.payload = damage(request.payload, flips)
    return request.SerializeToString()


def _varint(raw: bytes, at: int) -> tuple[int, int]:
    value = 0
    for shift in range(0, 70, 7):
        if at >= len(raw):
            break
        byte = raw[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
    raise WireError("not a PushRequest: it is cut off")
