"""Faults of the link, one file each, loaded only if the scenario lists them.

A fault module has a dataclass ``Params`` (its keys in the scenario) and a class ``Effect`` made from
(params, seed, camera). Its random decisions are looked up by (camera, offer number) like the link's own.
"""

from __future__ import annotations

import importlib
from typing import Any

from channel_emu.model.instants import NEVER_NS
from channel_emu.model.link import Fault, Transit

NAMES = ("loss", "duplication", "corruption", "blackout", "reset", "bandwidth")


class NoFault:
    """What every fault leaves alone."""

    def extra_ns(self, transit: Transit) -> int:
        """Added to the delay at the start of transmission."""
        return 0

    def loses(self, transit: Transit) -> bool:
        """Asked when the frame is due."""
        return False

    def duplicates(self, transit: Transit) -> bool:
        return False

    def flips(self, transit: Transit) -> tuple[tuple[float, int], ...]:
        """Damage to the payload: (place in [0, 1), non-zero byte to exclusive-or with)."""
        return ()

    def next_reset_ns(self, after_ns: int) -> int:
        """First reset of the camera's stream after an instant."""
        return NEVER_NS


def params_class(name: str) -> type[Any]:
    """The parameter dataclass of a listed fault; this is what imports its module."""
    return importlib.import_module(f"channel_emu.model.faults.{name}").Params


def make(params: dict[str, Any], seed: int, camera: str) -> tuple[Fault, ...]:
    """The listed faults for one camera, in the order of NAMES, whatever order they were listed in."""
    return tuple(
        importlib.import_module(f"channel_emu.model.faults.{name}").Effect(params[name], seed, camera)
        for name in NAMES
        if name in params
    )


def probability(name: str, value: float) -> None:
    """Shared check of parameters that are probabilities. Raises ValueError."""
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name}: expected a probability from 0 to 1, got {value:g}")
