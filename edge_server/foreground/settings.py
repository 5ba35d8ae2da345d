"""The section ``edge.foreground`` of a scenario."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from msgspec import field
from msgspec.structs import replace

from freshfield.settings import Settings, about, read_settings, within

MODELS = Path(__file__).parent / "models"
# The segmentation models that we ship, by the name of the object: the file in ``MODELS``.
SHIPPED = {"tile": "tile_int8.onnx"}


class ForegroundConfig(Settings, frozen=True):
    """The section ``edge.foreground`` of a scenario. Of several detections the surest counts."""

    detector: Annotated[str, about("YOLO segmentation ONNX (any -seg), relative to the scenario, or tile: shipped")]
    kinds: Annotated[list[str], about("class names to detect; none: any")] = field(default_factory=list)
    confidence: Annotated[float, within(0.0, 1.0, "minimum score")] = 0.25
    margin: Annotated[float, within(0.0, 1.0, "added to each side of a detected box, as a share of it")] = 0.05


def read_foreground(mapping: Mapping[str, Any], scenario: Path) -> ForegroundConfig:
    """Read the section ``edge.foreground`` of file ``scenario``; raises freshfield.scenario.ScenarioError."""
    values = dict(mapping) if isinstance(mapping, Mapping) else mapping
    config = read_settings(ForegroundConfig, values, f"{scenario}: edge.foreground")
    if config.detector in SHIPPED:
        return config
    return replace(config, detector=str(scenario.parent / config.detector))
