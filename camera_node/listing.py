"""The output of ``camera-node sources`` and ``camera-node effects``, taken from the settings' dataclasses."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

from camera_node.config import MODELS, ArmConfig, PathConfig, SourceConfig


def sources() -> str:
    """Every kind of source with its keys and their defaults."""
    lines = [_doc(SourceConfig), "", *_keys(SourceConfig)]
    common = [f.name for f in dataclasses.fields(SourceConfig)]
    for kind, model in MODELS.items():
        lines += ["", f"source: {{kind: {kind}, ...}}", ""]
        for part in reversed(model.__mro__):
            if issubclass(part, SourceConfig) and part is not SourceConfig:
                lines += [_doc(part), ""]
        lines += _keys(model, leave_out=common)
    for name, part in (("arm: {...}", ArmConfig), ("arm: {path: {...}}", PathConfig)):
        lines += ["", f"source: {{{name}}}", "", _doc(part), "", *_keys(part)]
    return "\n".join(lines)


def effects() -> str:
    """Every effect with its parameters and their defaults."""
    from camera_node.synthetic.effects import NAMES, effect_class

    lines = ["source: {effects: {NAME: {parameters}}}; held-out cameras are not affected unless in_truth: true"]
    for name in NAMES:
        effect = effect_class(name)
        lines += ["", f"{name} (acts on: {effect.kind})", "", _doc(effect), "", *_keys(effect)]
    return "\n".join(lines)


def _doc(model: type) -> str:
    return "\n".join(f"  {line}".rstrip() for line in (inspect.getdoc(model) or "").splitlines())


def _keys(model: Any, leave_out: list[str] | None = None) -> list[str]:
    fields = [f for f in dataclasses.fields(model) if f.name not in (leave_out or [])]
    fields.sort(key=lambda f: bool(f.kw_only))  # fields that all effects share come last
    return [f"    {f.name:22} {_default(f)}" for f in fields]


def _default(item: dataclasses.Field[Any]) -> str:
    if item.default is not dataclasses.MISSING:
        return "not given" if item.default in (None, "") else f"default {item.default!r}"
    return "empty" if item.default_factory is not dataclasses.MISSING else "required"
