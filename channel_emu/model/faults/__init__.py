"""Faults of the link, loaded only if the scenario lists them.

A fault's module has settings ``Params`` (its keys in the scenario) and a subclass of ``link.Fault`` with the fault's
name, constructed from (params, seed, camera). Like the link, it looks up its random numbers by (camera, offer number).
"""

from __future__ import annotations

import importlib
from typing import Any

from channel_emu.model.link import Fault

NAMES = ("loss", "duplication", "corruption", "blackout", "reset", "bandwidth")


# Where not a module of the fault's own name.
_MODULES = {"loss": "chance", "duplication": "chance"}


def params_class(name: str) -> type[Any]:
    """The parameters of the fault ``name``, one of NAMES. Imports the fault's module."""
    return _module(name).Params


def make(params: dict[str, Any], seed: int, camera: str) -> tuple[Fault, ...]:
    """The faults of one camera, in the order of NAMES. params: ``Params`` by fault name."""
    listed = [name for name in NAMES if name in params]
    return tuple(getattr(_module(name), name.capitalize())(params[name], seed, camera) for name in listed)


def _module(name: str) -> Any:
    return importlib.import_module(f"channel_emu.model.faults.{_MODULES.get(name, name)}")


def per_state(value: float | list[float]) -> list[float]:
    """A value as a list: one entry a state, or one for all."""
    return list(value) if isinstance(value, list) else [value]
