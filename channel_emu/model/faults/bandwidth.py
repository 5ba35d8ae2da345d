"""A line of finite rate: each frame's size over the rate is added to its delay."""

from __future__ import annotations

import math
from typing import Annotated

from channel_emu.model.link import Fault, Transit
from channel_emu.model.nanoseconds import saturating_round
from freshfield.settings import Settings, within


class Params(Settings, frozen=True):
    # The least is a bit in a quarter of an hour.
    megabits_per_s: Annotated[float, within(1e-9, math.inf, "rate of the line")]


class Bandwidth(Fault):
    by_size = True

    def __init__(self, params: Params, seed: int, camera: str) -> None:
        self.ns_per_byte = 8e3 / params.megabits_per_s

    def extra_ns(self, transit: Transit) -> int:
        return saturating_round(transit.size_bytes * self.ns_per_byte)
