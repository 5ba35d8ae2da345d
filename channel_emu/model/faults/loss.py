"""Loses frames: transmission takes its time, then nothing arrives."""

from __future__ import annotations

from dataclasses import dataclass

from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.faults import probability
from channel_emu.model.link import Fault, Transit


@dataclass(frozen=True)
class Params:
    probability: float

    def __post_init__(self) -> None:
        probability("probability", self.probability)


class Effect(Fault):
    def __init__(self, params: Params, seed: int, camera: str) -> None:
        self.params = params
        self.rng = CounterRng(seed, camera, "channel.loss")

    def loses(self, transit: Transit) -> bool:
        return self.rng.uniform(transit.number) < self.params.probability
