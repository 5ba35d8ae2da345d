"""Damages bytes of the payload in transit: the edge must refuse the frame by its CRC."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from channel_emu.model.faults import chance
from channel_emu.model.link import Transit
from freshfield.settings import within

if TYPE_CHECKING:
    from freshfield.v1 import frames_pb2


class Params(chance.Params, frozen=True):
    count: Annotated[int, within(1, 1000, "bytes to damage in a frame that is hit")] = 1


class Corruption(chance.ChanceFault):
    purpose = "channel.corruption"

    def flips(self, transit: Transit) -> tuple[tuple[float, int], ...]:
        if not self.hits(transit):
            return ()
        pairs = (self.rng.pair(transit.number, 1 + i) for i in range(self.params.count))
        return tuple((place, 1 + int(value * 255)) for place, value in pairs)


def damage(payload: bytes, flips: tuple[tuple[float, int], ...]) -> bytes:
    """A copy of the payload with the damage of ``Transit.flips`` applied; an empty payload stays empty."""
    data = bytearray(payload)
    for place, mask in flips:
        if data:
            data[int(place * len(data))] ^= mask
    return bytes(data)


def damage_frame(request: frames_pb2.PushRequest, flips: tuple[tuple[float, int], ...]) -> None:
    """Damage a frame: its image and its depth are one run of bytes."""
    image = len(request.payload)
    data = damage(request.payload + request.depth.payload, flips)
    request.payload = data[:image]
    if data[image:]:
        request.depth.payload = data[image:]
