"""The section ``edge.embedding`` of a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec.structs import replace

from freshfield.settings import Settings, about, read_settings, within

DEFAULT = "default"


class EmbeddingConfig(Settings, frozen=True):
    """The section ``edge.embedding`` of a scenario."""

    model: Annotated[str, about("a YOLO detection ONNX, relative to the scenario, or default")] = DEFAULT
    dim: Annotated[int, within(1, 4096, "length of an embedding, at most the channels at the backbone's end")] = 32


def read_embedding(mapping: Mapping[str, Any], scenario: Path) -> EmbeddingConfig:
    """Read the section ``edge.embedding`` of file ``scenario``; raises freshfield.scenario.ScenarioError."""
    values = dict(mapping) if isinstance(mapping, Mapping) else mapping
    config = read_settings(EmbeddingConfig, values, f"{scenario}: edge.embedding")
    if config.model == DEFAULT:
        return config
    return replace(config, model=str(scenario.parent / config.model))
