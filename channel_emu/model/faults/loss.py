"""Loses frames: transmission takes its time, then nothing arrives."""

from __future__ import annotations

from dataclasses import dataclass

from channel_emu.model.counter_rng import Uniforms
from channel_emu.model.faults import NoFault, probability
from channel_emu.model.link import Transit


@dataclass(frozen=True)
class Params:
    probability: float

    def __post_init__(self) -> None:
        probability("probability", self.probability)


class Effect(NoFault):
    def __init__(self, params: Params, seed: int, camera: str) -> None:
        self.params = params
        self.uniforms = Uniforms(seed, camera, "channel.loss")

    def loses(self, transit: Transit) -> bool:
        return self.uniforms.uniform(transit.number) < self.params.probability
