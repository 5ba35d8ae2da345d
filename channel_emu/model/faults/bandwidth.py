"""A line of finite rate: each frame's size over the rate is added to its delay."""

from __future__ import annotations

from dataclasses import dataclass

from channel_emu.model.link import Fault, Transit
from channel_emu.model.nanoseconds import saturating_round


@dataclass(frozen=True)
class Params:
    megabits_per_s: float

    def __post_init__(self) -> None:
        if not self.megabits_per_s >= 1e-9:  # a bit in a quarter of an hour
            raise ValueError(f"megabits_per_s: expected at least 1e-9, got {self.megabits_per_s:g}")


class Effect(Fault):
    by_size = True

    def __init__(self, params: Params, seed: int, camera: str) -> None:
        self.ns_per_byte = 8e3 / params.megabits_per_s

    def extra_ns(self, transit: Transit) -> int:
        return saturating_round(transit.size_bytes * self.ns_per_byte)
