"""Representations by name. A package is imported only when its representation is asked for.

A package has, in ``settings``, the settings class ``SETTINGS``, which names the module with ``make(settings)``, and
``EFFORTS``, presets of its options.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from edge_server.fields import Field
from edge_server.fields.common import trainer_settings

_PACKAGES: dict[str, str] = {
    "ngp": "edge_server.fields.ngp",
    "nerfacto": "edge_server.fields.nerfacto",
    "tensorf": "edge_server.fields.tensorf",
    "splat": "edge_server.fields.splat",
}


def field_names() -> tuple[str, ...]:
    """The names of all representations."""
    return tuple(_PACKAGES)


def option_help(name: str) -> dict[str, str]:
    """Option -> what it means. ValueError: unknown representation."""
    return trainer_settings.option_help(_module(name, "settings").SETTINGS)


def efforts_of(name: str) -> Mapping[str, Mapping[str, Any]]:
    """Preset -> its options. ValueError: unknown representation."""
    found: Mapping[str, Mapping[str, Any]] = _module(name, "settings").EFFORTS
    return found


def make_field(name: str, options: Mapping[str, Any] | None = None, seed: int = 0) -> Field:
    """A fresh field.

    name: one of ``field_names``.
    options: see ``option_help``, and ``effort``, one of ``efforts_of``; None: the defaults.
    seed: of the field, unless ``options`` has one.
    Raises ValueError for an unknown representation or option (the message lists the known ones), or for a
    value that it cannot have.
    """
    from edge_server.fields.compiling import log_compilation  # names and options are known without numba

    log_compilation()
    settings = settings_of(name, options, seed)
    make: Callable[[Any], Field] = import_module(f"edge_server.fields.{settings.module}").make
    return make(settings)


def settings_of(name: str, options: Mapping[str, Any] | None = None, seed: int = 0) -> Any:
    """The settings that these options result in, with defaults and effort. ValueError as
    ``make_field``."""
    module = _module(name, "settings")
    return trainer_settings.settings_from(module.SETTINGS, module.EFFORTS, options or {}, seed)


def _module(name: str, module: str) -> Any:
    if name not in _PACKAGES:
        raise ValueError(f"no field is called {name!r}; there are: {', '.join(_PACKAGES)}")
    return import_module(f"{_PACKAGES[name]}.{module}")
