"""Every key that a scenario file may have, from the settings that read it: as text and as JSON Schema."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterator
from typing import Any

import msgspec

from camera_node.settings import MODELS, SourceConfig
from camera_node.synthetic import effects
from channel_emu.model import faults, presets
from channel_emu.model.settings import ChannelConfig
from freshfield.scenario import Cameras, ScenarioFile
from freshfield.settings import ScenarioError, Settings, bare_type, describe

NOTATIONS = ("arrivals", "chain", "service")
"""Keys of ``channel`` that may be written as on the command line (``exp:60ms``)."""


def text(section: str | None) -> str:
    """Keys of a section, or of all, with what is allowed, defaults and help. Raises ScenarioError."""
    if section is not None and section not in SECTIONS:
        raise ScenarioError(f"no section is called {section!r}; there are: {', '.join(SECTIONS)}")
    chosen = [section] if section else list(SECTIONS)
    return "\n".join(line for name in chosen for line in SECTIONS[name]()).strip("\n")


def schema() -> dict[str, Any]:
    """The JSON Schema (2020-12) of a scenario file, without what only reading the data can tell."""
    listed = {name: effects.effect_class(name) for name in effects.NAMES}
    lossy = {name: faults.params_class(name) for name in faults.NAMES}
    edge = _edge_models()
    models = [Cameras, ChannelConfig, *MODELS.values(), *listed.values(), *lossy.values(), *edge.values()]
    found, parts = msgspec.json.schema_components(models, schema_hook=_of_path, ref_template="#/$defs/{name}")
    part = dict(zip(models, found))  # model -> {"$ref": ...}
    kinds = []
    for kind, model in MODELS.items():  # two kinds may share a struct
        keys = parts[model.__name__]
        effect = {name: {"anyOf": [part[each], {"type": "null"}]} for name, each in listed.items()}
        known = {**keys["properties"], "kind": {"const": kind}, "effects": _mapping(effect)}
        kinds.append({**keys, "title": kind, "properties": known})
    channel = parts[ChannelConfig.__name__]["properties"]
    for key in NOTATIONS:
        channel[key] = {"anyOf": [channel[key], {"type": "string"}]}
    channel["preset"] = {"enum": list(presets.PRESETS)}
    # The value of the first parameter alone is a fault, too.
    channel["faults"] = _mapping(
        {name: {"anyOf": [part[each], {"not": {"type": "object"}}]} for name, each in lossy.items()}
    )
    properties: dict[str, Any] = {
        "name": {"type": "string"},
        "description": {"type": "string"},
        "seed": {"type": "integer", "minimum": 0},
        "cameras": part[Cameras],
        "source": {"oneOf": kinds},
        "channel": {"anyOf": [part[ChannelConfig], {"type": "null"}]},
    }
    if edge:
        keys = parts["EdgeConfig"]["properties"]
        keys["compute"] = {"anyOf": [part[edge["edge.compute"]], {"type": "string"}]}
        for key in ("embedding", "foreground"):
            keys[key] = {"anyOf": [part[edge[f"edge.{key}"]], {"type": "null"}]}
        properties["edge"] = {"anyOf": [part[edge["edge"]], {"type": "null"}]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "freshfield scenario",
        **_mapping(properties),
        "$defs": parts,
    }


def _mapping(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _of_path(_: type) -> dict[str, Any]:
    return {"type": "string"}  # pathlib.Path, the one type that is not JSON's


def _cameras() -> Iterator[str]:
    yield from describe(ScenarioFile, ("cameras", "source", "channel", "edge"))
    yield from _described("cameras", Cameras)


def _source() -> Iterator[str]:
    yield from _described("source, of every kind", SourceConfig)
    common = SourceConfig.__struct_fields__
    shown: set[type] = set()
    for kind, model in MODELS.items():
        parents = [p for p in reversed(model.__mro__[1:]) if issubclass(p, SourceConfig) and p is not SourceConfig]
        yield from ("", *(f"  {line}" for p in parents for line in _doc(p)))
        yield from _described(f"source: {{kind: {kind}, ...}}", model, common, shown)


def _effects() -> Iterator[str]:
    yield "source.effects: {NAME: {parameters}}; held-out cameras are not affected unless in_truth: true"
    for name in effects.NAMES:
        found = effects.effect_class(name)
        yield from _described(f"{name} (acts on: {found.kind})", found)


def _channel() -> Iterator[str]:
    yield from _described("channel", ChannelConfig)
    yield from ("", f"  presets: {', '.join(presets.PRESETS)} (channel-emu presets)")


def _faults() -> Iterator[str]:
    yield "channel.faults: {NAME: {parameters}}, or {NAME: value of the first}"
    for name in faults.NAMES:
        yield from _described(name, faults.params_class(name))


def _edge() -> Iterator[str]:
    models = _edge_models()
    if not models:
        yield "edge: install the extra edge to see its keys"
        return
    shown: set[type] = set()
    for title, model in models.items():
        if model not in shown:
            yield from _described(title, model, shown=shown)
    from edge_server.fields.registry import field_names, option_help, settings_of

    for name in field_names():
        default = settings_of(name)
        yield from ("", f"edge.field_options of field {name}", "")
        for option, about in option_help(name).items():
            yield f"    {option:22} default {getattr(default, option)!r}; {about}"


def _edge_models() -> dict[str, type[Settings]]:
    """Title -> settings of the edge; empty without the extra ``edge``."""
    try:
        from edge_server.embed import EmbeddingConfig
        from edge_server.foreground import ForegroundConfig
        from edge_server.settings import ComputeConfig, EdgeConfig
    except ImportError:
        return {}
    return {
        "edge": EdgeConfig,
        "edge.compute": ComputeConfig,
        "edge.embedding": EmbeddingConfig,
        "edge.foreground": ForegroundConfig,
    }


SECTIONS: dict[str, Callable[[], Iterator[str]]] = {
    "cameras": _cameras,
    "source": _source,
    "effects": _effects,
    "channel": _channel,
    "faults": _faults,
    "edge": _edge,
}


def _described(
    title: str, model: type[Settings], leave_out: tuple[str, ...] = (), shown: set[type] | None = None
) -> Iterator[str]:
    """Title, docstring and keys of a struct, and of the structs within it that are not yet in ``shown``."""
    shown = set() if shown is None else shown
    shown.add(model)
    yield from ("", title, "", *(f"  {line}".rstrip() for line in _doc(model)), "", *describe(model, leave_out))
    for field in msgspec.structs.fields(model):
        inner = bare_type(field.type)
        if isinstance(inner, type) and issubclass(inner, Settings) and inner not in shown:
            yield from _described(f"{title.partition(',')[0].partition(':')[0]}.{field.name}", inner, shown=shown)


def _doc(model: type) -> list[str]:
    return (inspect.getdoc(model) or "").splitlines()
