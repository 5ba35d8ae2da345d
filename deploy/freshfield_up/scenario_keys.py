"""Every key that a scenario file may have, from the settings that read it: as text and as JSON Schema."""

from __future__ import annotations

import contextlib
import inspect
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from camera_node.settings import MODELS, SourceConfig, own_class
from camera_node.synthetic import effects
from channel_emu.model import faults, presets
from channel_emu.model.settings import NOTATIONS, ChannelConfig
from freshfield import plugins
from freshfield.scenario import Cameras, ScenarioFile
from freshfield.settings import ScenarioError, Settings, bare_type, describe, told_default

REFERENCE = ":"
"""JSON Schema's pattern of FILE.py:CLASS and MODULE:CLASS, whose parameters no schema of ours knows."""


def text(section: str | None, name: str | None = None) -> str:
    """Keys of a section, or of all, with what is allowed, defaults and help. Raises ScenarioError.

    name: the one source, effect, fault, field or policy that is told, such as one from outside; None: all of them.
    """
    if section is not None and section not in SECTIONS:
        raise ScenarioError(f"no section is called {section!r}; there are: {', '.join(SECTIONS)}")
    if name is not None and section is not None:
        if section not in _NAMED:
            raise ScenarioError(f"section {section!r} names no classes; these do: {', '.join(_NAMED)}")
        return "\n".join(_NAMED[section](plugins.absolute(name, Path()))).strip("\n")
    chosen = [section] if section else list(SECTIONS)
    return "\n".join(line for each in chosen for line in SECTIONS[each]()).strip("\n")


def schema() -> dict[str, Any]:
    """The JSON Schema (2020-12) of a scenario file, without what only reading the data can tell."""
    listed = dict(_known("effect", effects.NAMES, effects.effect_class))
    lossy = dict(_known("fault", faults.NAMES, faults.params_class))
    sources = dict(_known("source", MODELS, _source_keys))
    edge, options = _edge_models(), _field_options()
    models = [Cameras, ChannelConfig, *sources.values(), *listed.values(), *lossy.values(), *edge.values()]
    models += options.values()
    found, parts = msgspec.json.schema_components(models, schema_hook=_of_path, ref_template="#/$defs/{name}")
    part = dict(zip(models, found))  # model -> {"$ref": ...}
    kinds: list[Any] = [{"properties": {"kind": {"type": "string", "pattern": REFERENCE}}, "required": ["kind"]}]
    for kind, model in sources.items():  # two kinds may share a struct
        keys = parts[part[model]["$ref"].rpartition("/")[2]]
        effect = {name: {"anyOf": [part[each], {"type": "null"}]} for name, each in listed.items()}
        known = {**keys["properties"], "kind": {"const": kind}, "effects": _named(effect)}
        kinds.append({**keys, "title": kind, "properties": known})
    channel = parts[ChannelConfig.__name__]["properties"]
    for key in NOTATIONS:
        channel[key] = {"anyOf": [channel[key], {"type": "string"}]}
    channel["preset"] = {"enum": list(presets.PRESETS)}
    # The value of the first parameter alone is a fault, too.
    channel["faults"] = _named(
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
        keys["field_options"] = {"type": "object"}
        of_field = [{"if": _field_is(name), "then": _options(parts, part[each])} for name, each in options.items()]
        properties["edge"] = {"anyOf": [{**part[edge["edge"]], "allOf": of_field}, {"type": "null"}]}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "freshfield scenario",
        **_mapping(properties),
        "$defs": parts,
    }


def _mapping(properties: dict[str, Any]) -> dict[str, Any]:
    return {"type": "object", "properties": properties, "additionalProperties": False}


def _named(properties: dict[str, Any]) -> dict[str, Any]:
    """As ``_mapping``, where a key may also be a class from outside."""
    return {**_mapping(properties), "patternProperties": {REFERENCE: True}}


def _field_is(name: str) -> dict[str, Any]:
    from edge_server.fields.registry import FIELD

    return {"properties": {"field": {"const": name}}, "required": [] if name == FIELD else ["field"]}


def _options(parts: dict[str, Any], part: dict[str, str]) -> dict[str, Any]:
    """What field_options may hold: the fields of settings that have help, the others are no options."""
    told = parts[part["$ref"].rpartition("/")[2]]["properties"]
    options = {key: each for key, each in told.items() if "description" in each}
    return {"properties": {"field_options": _mapping(options)}}


def _of_path(_: type) -> dict[str, Any]:
    return {"type": "string"}  # pathlib.Path, the one type that is not JSON's


def _cameras() -> Iterator[str]:
    yield from ("the scenario itself", "", *describe(ScenarioFile, ("cameras", "source", "channel", "edge")))
    yield from _described("cameras", Cameras)


def _source() -> Iterator[str]:
    yield from _described("source, of every kind", SourceConfig)
    common = SourceConfig.__struct_fields__
    shown: set[type] = set()
    for kind, model in _known("source", MODELS, _source_keys):
        parents = [p for p in reversed(model.__mro__[1:]) if issubclass(p, SourceConfig) and p is not SourceConfig]
        yield from _described(f"source: {{kind: {kind}, ...}}", model, common, shown, parents)


def _source_keys(kind: str) -> type[SourceConfig]:
    return MODELS[kind] if kind in MODELS else own_class(kind)[1]


def _effects() -> Iterator[str]:
    yield "source.effects: {NAME: {parameters}}; held-out cameras are not affected unless in_truth: true"
    for name, found in _known("effect", effects.NAMES, effects.effect_class):
        yield from _described(f"{name} (acts on: {found.kind})", found)


def _channel() -> Iterator[str]:
    yield f"  presets: {', '.join(presets.PRESETS)} (channel-emu presets)"
    yield from _described("channel", ChannelConfig)


def _faults() -> Iterator[str]:
    yield "channel.faults: {NAME: {parameters}}, or {NAME: value of the first}"
    for name, found in _known("fault", faults.NAMES, faults.params_class):
        yield from _described(name, found)


def _edge() -> Iterator[str]:
    models = _edge_models()
    if not models:
        yield "edge: install the extra edge to see its keys"
        return
    shown: set[type] = set()
    for title, model in models.items():
        if model not in shown:
            yield from _described(title, model, shown=shown)
    for name in _field_options():
        yield from _field(name)
    from edge_server.scheduler import POLICIES

    for name, _ in _known("policy", POLICIES, _policy_class):
        yield from _policy(name)


def _field(name: str) -> Iterator[str]:
    from edge_server.fields.registry import option_help, settings_of

    default = settings_of(name)
    yield from ("", f"edge.field_options of field {name}", "")
    for option, about in option_help(name).items():
        told = told_default(getattr(default, option), about)
        yield f"    {option:22} {'; '.join(part for part in (told, about) if part)}"


def _policy(name: str) -> Iterator[str]:
    found = _policy_class(name)
    yield from ("", f"edge.policy: {{name: {name}}}", "", *(f"  {line}".rstrip() for line in _doc(found)), "")
    about = f"{told_default(found.value, '')}; {found.parameter}" if found.parameter else "it takes none"
    yield f"    {'value':22} {about}"


def _policy_class(name: str) -> Any:
    from edge_server.scheduler import POLICIES

    return POLICIES[name][0] if name in POLICIES else plugins.find("policy", name, POLICIES)


def _field_or_policy(name: str) -> Iterator[str]:
    from edge_server.scheduler import POLICIES, Policy

    known = name in POLICIES or name in plugins.installed("policy")
    own = plugins.is_reference(name) and issubclass(plugins.find("policy", name, ()), Policy)
    return _policy(name) if known or own else _field(name)


def _field_options() -> dict[str, type[Settings]]:
    """Field -> settings that hold its options; empty without the extra ``edge``."""
    try:
        from edge_server.fields.registry import field_names, settings_of
    except ImportError:
        return {}
    return dict(_known("field", field_names(), lambda name: type(settings_of(name))))


def _known(kind: str, built_in: Iterable[str], find: Callable[[str], Any]) -> Iterator[tuple[str, Any]]:
    """Name and class of what is built in and of the entry points of installed packages. One that cannot be imported is
    left out: naming it tells why."""
    yield from ((name, find(name)) for name in built_in)
    for name in plugins.installed(kind):
        with contextlib.suppress(ScenarioError):
            yield name, find(name)


def _edge_models() -> dict[str, type[Settings]]:
    """Title -> settings of the edge; empty without the extra ``edge``."""
    try:
        from edge_server.embed.settings import EmbeddingConfig
        from edge_server.foreground.settings import ForegroundConfig
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
_NAMED: dict[str, Callable[[str], Iterator[str]]] = {
    "source": lambda name: _described(f"source: {{kind: {name}, ...}}", _source_keys(name)),
    "effects": lambda name: _described(name, effects.effect_class(name)),
    "faults": lambda name: _described(name, faults.params_class(name)),
    "edge": _field_or_policy,
}


def _described(
    title: str,
    model: type[Settings],
    leave_out: tuple[str, ...] = (),
    shown: set[type] | None = None,
    parents: Sequence[type[Settings]] = (),
) -> Iterator[str]:
    """Title, docstrings and keys of a struct, and of the structs within it that are not yet in ``shown``.

    parents: bases whose docstrings tell of some of its keys.
    """
    shown = set() if shown is None else shown
    shown.add(model)
    docs = [f"  {line}".rstrip() for each in (model, *parents) if _doc(each) for line in (*_doc(each), "")]
    yield from ("", title, "", *(docs or [""]), *describe(model, leave_out))
    for field in msgspec.structs.fields(model):
        inner = bare_type(field.type)
        if isinstance(inner, type) and issubclass(inner, Settings) and inner not in shown:
            yield from _described(f"{title.partition(',')[0].partition(':')[0]}.{field.name}", inner, shown=shown)


def _doc(model: type) -> list[str]:
    """Its own docstring; of a fault that has none the first line of its module's."""
    module = sys.modules[model.__module__].__doc__ or ""
    own = model.__dict__.get("__doc__") or (module.partition("\n")[0] if model.__name__ == "Params" else "")
    return inspect.cleandoc(own).splitlines()
