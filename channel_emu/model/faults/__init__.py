"""Faults of the link, one file each, loaded only if the scenario lists them.

A fault module has a dataclass ``Params`` (its keys in the scenario) and a subclass ``Effect`` of
``link.Fault``, constructed from (params, seed, camera). Like the link, it looks up its random numbers by
(camera, offer number).
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass
from typing import Any, ClassVar

from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.link import Fault, Transit

NAMES = ("loss", "duplication", "corruption", "blackout", "reset", "bandwidth", "mahimahi")


def params_class(name: str) -> type[Any]:
    """The parameter dataclass of the fault ``name``, one of NAMES. Imports the fault's module."""
    return importlib.import_module(f"channel_emu.model.faults.{name}").Params


def make(params: dict[str, Any], seed: int, camera: str) -> tuple[Fault, ...]:
    """The faults of one camera, in the order of NAMES. params: ``Params`` by fault name."""
    return tuple(
        importlib.import_module(f"channel_emu.model.faults.{name}").Effect(params[name], seed, camera)
        for name in NAMES
        if name in params
    )


@dataclass(frozen=True)
class ChanceParams:
    """Parameters of a ``ChanceFault``.

    probability: one number, or one for each chain state in which transmission may start (for losses, the
        Gilbert-Elliott model).
    """

    probability: float | list[float]

    def __post_init__(self) -> None:
        for p in per_state(self.probability):
            if not 0.0 <= p <= 1.0:
                raise ValueError(f"probability: expected a probability from 0 to 1, got {p:g}")


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
