"""What ``camera-node sources`` and ``camera-node effects`` print, read off the models themselves."""

from __future__ import annotations

import dataclasses
import inspect
from typing import Any

from camera_node.config import MODELS, SourceConfig


def sources() -> str:
    """Every kind with its keys, defaults and the keys common to all."""
    common = {f.name for f in dataclasses.fields(SourceConfig)}
    lines = ["source: keys of every kind", "", _indented(SourceConfig), ""]
    for kind, model in MODELS.items():
        lines += [f"source: {{kind: {kind}, ...}}", "", _indented(model), ""]
        for item in dataclasses.fields(model):
            if item.name not in common:
                lines.append(f"  {item.name:20} {_default(item)}")
        lines.append("")
    return "\n".join(lines).rstrip()


def _indented(model: type) -> str:
    return "\n".join(f"  {line}".rstrip() for line in inspect.getdoc(model).splitlines())  # type: ignore[union-attr]


def _default(item: dataclasses.Field[Any]) -> str:
    if item.default is not dataclasses.MISSING:
        return "not given" if item.default is None else f"default {item.default!r}"
    return "empty" if item.default_factory is not dataclasses.MISSING else "required"
