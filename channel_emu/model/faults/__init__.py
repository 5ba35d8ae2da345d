"""Faults of the link, one file each, loaded only if the scenario lists them.

A fault module has a dataclass ``Params`` (its keys in the scenario) and a class ``Effect`` made from
(params, seed, camera). Like the link, it looks its random numbers up by (camera, offer number).
"""

from __future__ import annotations

import importlib
from typing import Any

from channel_emu.model.link import Fault

NAMES = ("loss", "duplication", "corruption", "blackout", "reset", "bandwidth")


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
