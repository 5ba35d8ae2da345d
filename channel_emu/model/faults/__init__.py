"""Faults of the link, one file each, loaded only if the scenario lists them.

A fault module has settings ``Params`` (its keys in the scenario) and a subclass ``Effect`` of
``link.Fault``, constructed from (params, seed, camera). Like the link, it looks up its random numbers by
(camera, offer number).
"""

from __future__ import annotations

import importlib
from typing import Annotated, Any, ClassVar

from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.link import Fault, Transit
from freshfield.settings import Settings, within

NAMES = ("loss", "duplication", "corruption", "blackout", "reset", "bandwidth", "mahimahi")


def params_class(name: str) -> type[Any]:
    """The parameters of the fault ``name``, one of NAMES. Imports the fault's module."""
    return importlib.import_module(f"channel_emu.model.faults.{name}").Params


def make(params: dict[str, Any], seed: int, camera: str) -> tuple[Fault, ...]:
    """The faults of one camera, in the order of NAMES. params: ``Params`` by fault name."""
    return tuple(
        importlib.import_module(f"channel_emu.model.faults.{name}").Effect(params[name], seed, camera)
        for name in NAMES
        if name in params
    )


Probability = Annotated[float, within(0.0, 1.0, "of each frame")]


class ChanceParams(Settings, frozen=True):
    """Parameters of a ``ChanceFault``.

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


def per_state(value: float | list[float]) -> list[float]:
    """A value as a list: one entry a state, or one for all."""
    return list(value) if isinstance(value, list) else [value]
