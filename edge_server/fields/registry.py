"""Representations by name. A module is imported only when its representation is asked for."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from edge_server.fields import Field
from edge_server.fields.option_types import checked

# name -> "module:function"; the function takes (options, seed) and raises ValueError for a wrong option
_FIELDS: dict[str, str] = {
    "ngp": "edge_server.fields.ngp.field:make",
    "nerfacto": "edge_server.fields.nerfacto.field:make",
    "tensorf": "edge_server.fields.tensorf.field:make",
    "splat": "edge_server.fields.splat.field:make",
    "voxel": "edge_server.fields.voxel.field:make",
}


def field_names() -> tuple[str, ...]:
    """The representations there are."""
    return tuple(_FIELDS)


def option_help(name: str) -> dict[str, str]:
    """What each option of a representation means. ValueError: there is no such representation."""
    if name not in _FIELDS:
        raise ValueError(f"no field is called {name!r}; there are: {', '.join(_FIELDS)}")
    found: dict[str, str] = import_module(f"edge_server.fields.{name}.settings").help_text()
    return found


def efforts_of(name: str) -> Mapping[str, Mapping[str, Any]]:
    """The presets of a representation by name. ValueError: there is no such representation."""
    if name not in _FIELDS:
        raise ValueError(f"no field is called {name!r}; there are: {', '.join(_FIELDS)}")
    found: Mapping[str, Mapping[str, Any]] = import_module(f"edge_server.fields.{name}.settings").EFFORTS
    return found


def make_field(name: str, options: Mapping[str, Any] | None = None, seed: int = 0) -> Field:
    """A fresh field. ValueError: no such representation, or an option it does not have (both are listed)."""
    given = _checked(name, options or {})
    module, _, function = _FIELDS[name].partition(":")
    make: Callable[[dict[str, Any], int], Field] = getattr(import_module(module), function)
    return make(given, seed)


def settings_of(name: str, options: Mapping[str, Any] | None = None) -> Any:
    """What options come to, defaults and effort among them: a dataclass. ValueError as ``make_field``."""
    given = _checked(name, options or {})
    return import_module(f"edge_server.fields.{name}.settings").make_settings(given)


def _checked(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    if name not in _FIELDS:
        raise ValueError(f"no field is called {name!r}; there are: {', '.join(_FIELDS)}")
    settings = getattr(import_module(f"edge_server.fields.{name}.settings"), f"{name.capitalize()}Settings")
    given = checked(name, settings, options)
    if not isinstance(given.get("effort", ""), str):
        raise ValueError(f"{name}: effort must be a name, not {given['effort']!r}")
    return given
