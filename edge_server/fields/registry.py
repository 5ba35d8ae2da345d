"""Representations by name. A package is imported only when its representation is asked for.

A package has, in ``settings``, the settings class ``SETTINGS``, which names the module with ``make(settings)``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

from edge_server.fields import Field
from edge_server.fields.common import settings as field_settings
from freshfield import plugins

_PACKAGES = ("ngp", "nerfacto", "tensorf", "splat")
FIELD = "splat"
"""The usual representation."""


def field_names() -> tuple[str, ...]:
    """The names of all representations."""
    return _PACKAGES


def option_help(name: str) -> dict[str, str]:
    """Option -> what it means. ValueError: unknown representation."""
    return field_settings.option_help(_settings_class(name))


def make_field(name: str, options: Mapping[str, Any] | None = None, seed: int = 0) -> Field:
    """A fresh field.

    name: one of ``field_names``, or a class from outside (``freshfield.plugins``), which is constructed with its
        settings: of the class in its attribute ``Settings``, a subclass of ``FieldSettings``.
    options: see ``option_help``; None: the defaults.
    seed: of the field, unless ``options`` has one.
    Raises ValueError for an unknown representation or option (the message lists the known ones), or for a
    value that it cannot have.
    """
    from edge_server.fields.compiling import log_compilation  # names and options are known without numba

    log_compilation()
    settings = settings_of(name, options, seed)
    if name not in _PACKAGES:
        outside: Field = plugins.find("field", name, _PACKAGES)(settings)
        return outside
    make: Callable[[Any], Field] = import_module(f"edge_server.fields.{settings.module}").make
    return make(settings)


def settings_of(name: str, options: Mapping[str, Any] | None = None, seed: int = 0) -> Any:
    """The settings that these options result in, with defaults. ValueError as ``make_field``."""
    return field_settings.settings_from(_settings_class(name), options or {}, seed)


def _settings_class(name: str) -> Any:
    if name in _PACKAGES:
        return import_module(f"edge_server.fields.{name}.settings").SETTINGS
    found = getattr(plugins.find("field", name, _PACKAGES), "Settings", None)
    if not (isinstance(found, type) and issubclass(found, field_settings.FieldSettings)):
        raise plugins.PluginError(f"field {name}: expected an attribute Settings, a subclass of FieldSettings")
    return found
