"""Faults that hit each frame with a probability: loss and duplication, and what ``corruption`` shares with them."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar

from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.faults import per_state
from channel_emu.model.link import Fault, Transit
from freshfield.settings import Settings, within

Probability = Annotated[float, within(0.0, 1.0, "of each frame")]


class Params(Settings, frozen=True):
    """A fault that hits each frame with a probability.

    probability: one number, or one for each chain state in which transmission may start (for losses, the
        Gilbert-Elliott model).
    """

    probability: Probability | list[Probability]


class ChanceFault(Fault):
    """Base of the faults that hit each frame with a probability. purpose: name of the random stream."""

    purpose: ClassVar[str]

    def __init__(self, params: Any, seed: int, camera: str) -> None:
        self.params = params
        self.rng = CounterRng(seed, camera, self.purpose)
        self._by_state = per_state(params.probability)

    def hits(self, transit: Transit) -> bool:
        """Whether the fault hits this frame."""
        p = self._by_state[transit.state if len(self._by_state) > 1 else 0]
        return self.rng.uniform(transit.number) < p


class Loss(ChanceFault):
    """Loses frames: a lost frame occupies the link for its whole transmission, but never arrives."""

    purpose = "channel.loss"

    def loses(self, transit: Transit) -> bool:
        return self.hits(transit)


class Duplication(ChanceFault):
    """Delivers a frame twice: the edge must notice the repeated sequence number."""

    purpose = "channel.duplication"

    def duplicates(self, transit: Transit) -> bool:
        return self.hits(transit)
