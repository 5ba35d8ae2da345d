"""The output of ``camera-node sources`` and ``camera-node effects``, taken from the settings themselves."""

from __future__ import annotations

import inspect

from camera_node.settings import MODELS, ArmConfig, PathConfig, SourceConfig
from freshfield.settings import describe


def sources() -> str:
    """Every kind of source with its keys and their defaults."""
    lines = [_doc(SourceConfig), "", *describe(SourceConfig)]
    common = SourceConfig.__struct_fields__
    for kind, model in MODELS.items():
        lines += ["", f"source: {{kind: {kind}, ...}}", ""]
        for part in reversed(model.__mro__):
            if issubclass(part, SourceConfig) and part is not SourceConfig:
                lines += [_doc(part), ""]
        lines += describe(model, common)
    for name, part in (("arm: {...}", ArmConfig), ("arm: {path: {...}}", PathConfig)):
        lines += ["", f"source: {{{name}}}", "", _doc(part), "", *describe(part)]
    return "\n".join(lines)


def effects() -> str:
    """Every effect with its parameters and their defaults."""
    from camera_node.synthetic.effects import NAMES, effect_class

    lines = ["source: {effects: {NAME: {parameters}}}; held-out cameras are not affected unless in_truth: true"]
    for name in NAMES:
        effect = effect_class(name)
        lines += ["", f"{name} (acts on: {effect.kind})", "", _doc(effect), "", *describe(effect)]
    return "\n".join(lines)


def _doc(model: type) -> str:
    return "\n".join(f"  {line}".rstrip() for line in (inspect.getdoc(model) or "").splitlines())
