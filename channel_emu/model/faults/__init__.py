"""Faults of the link, loaded only if the scenario lists them.

A fault's module has settings ``Params`` (its keys in the scenario) and a subclass of ``link.Fault`` with the fault's
name, constructed from (params, seed, camera). Like the link, it looks up its random numbers by (camera, offer number).
"""

from __future__ import annotations

import importlib
from typing import Any

from channel_emu.model.link import Fault
from freshfield import plugins
from freshfield.settings import Settings

NAMES = ("loss", "duplication", "corruption", "blackout", "reset", "bandwidth")


# Modules of faults whose module does not have the fault's name.
_MODULES = {"loss": "chance", "duplication": "chance"}


def params_class(name: str) -> type[Any]:
    """The parameters of the fault ``name``, one of NAMES or a plug-in (``freshfield.plugins``). Imports the fault's
    module. Raises PluginError for an unknown name."""
    if name in NAMES:
        return _module(name).Params  # type: ignore[no-any-return]
    found: Any = getattr(_outside(name), "Params", None)
    if not (isinstance(found, type) and issubclass(found, Settings)):
        raise plugins.PluginError(
            f"fault {name}: expected an attribute Params, a subclass of freshfield.settings.Settings"
        )
    return found


def make(params: dict[str, Any], seed: int, camera: str) -> tuple[Fault, ...]:
    """The faults of one camera, in the order of NAMES, then plug-ins. params: ``Params`` by fault name."""
    listed = [name for name in NAMES if name in params]
    built_in = [getattr(_module(name), name.capitalize())(params[name], seed, camera) for name in listed]
    others = [_outside(name)(params[name], seed, camera) for name in params if name not in NAMES]
    return (*built_in, *others)


def _outside(name: str) -> type[Any]:
    found: type[Any] = plugins.find("fault", name, NAMES)
    if not issubclass(found, Fault):
        raise plugins.PluginError(f"fault {name}: {found.__name__} does not derive from channel_emu.model.link.Fault")
    return found


def _module(name: str) -> Any:
    return importlib.import_module(f"channel_emu.model.faults.{_MODULES.get(name, name)}")


def per_state(value: float | list[float]) -> list[float]:
    """A value as a list: one entry per chain state, or one for all."""
    return list(value) if isinstance(value, list) else [value]
