"""Representations by name. A package is imported only when its representation is asked for.

A package has ``field.make(options, seed)`` and, in ``settings``, ``EFFORTS``, ``help_text()`` and
``make_settings(options)``, whose return annotation is the settings' dataclass.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any, get_type_hints

from edge_server.fields import Field
from edge_server.fields.option_types import checked

_PACKAGES: dict[str, str] = {
    "ngp": "edge_server.fields.ngp",
    "nerfacto": "edge_server.fields.nerfacto",
    "tensorf": "edge_server.fields.tensorf",
    "splat": "edge_server.fields.splat",
    "voxel": "edge_server.fields.voxel",
}


def field_names() -> tuple[str, ...]:
    """The names of all representations."""
    return tuple(_PACKAGES)


def option_help(name: str) -> dict[str, str]:
    """Option -> what it means. ValueError: unknown representation."""
    found: dict[str, str] = _module(name, "settings").help_text()
    return found


def efforts_of(name: str) -> Mapping[str, Mapping[str, Any]]:
    """Preset -> its options. ValueError: unknown representation."""
    found: Mapping[str, Mapping[str, Any]] = _module(name, "settings").EFFORTS
    return found


def make_field(name: str, options: Mapping[str, Any] | None = None, seed: int = 0) -> Field:
    """A fresh field. ValueError: unknown representation or option (the message lists the known ones)."""
    given = _checked(name, options or {})
    make: Callable[[dict[str, Any], int], Field] = _module(name, "field").make
    return make(given, seed)


def settings_of(name: str, options: Mapping[str, Any] | None = None) -> Any:
    """The settings dataclass that these options result in, with defaults and effort. ValueError as
    ``make_field``."""
    return _module(name, "settings").make_settings(_checked(name, options or {}))


def _module(name: str, module: str) -> Any:
    if name not in _PACKAGES:
        raise ValueError(f"no field is called {name!r}; there are: {', '.join(_PACKAGES)}")
    return import_module(f"{_PACKAGES[name]}.{module}")


def _checked(name: str, options: Mapping[str, Any]) -> dict[str, Any]:
    kind = get_type_hints(_module(name, "settings").make_settings)["return"]
    given = checked(name, kind, options)
    if not isinstance(given.get("effort", ""), str):
        raise ValueError(f"{name}: effort must be a name, not {given['effort']!r}")
    return given
