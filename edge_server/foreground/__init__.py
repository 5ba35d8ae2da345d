"""Foreground segmentation of images before the field is trained (thesis 4.4.3).

A YOLO segmentation model detects the object and labels its pixels; the mask within the box stays, and the
background becomes transparent, which supervises the field with empty space there. Poses do not change. The
scenario key ``edge.foreground`` enables it; without that key this package is not imported. Held-out frames
are not masked: fidelity is measured on whole images, background included.
"""

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
# Why an image is used whole, by the name of its count (``foreground.Foreground``).
WHY = {
    "not_detected": "nothing was found in it",
    "full_mask": "all of it was found to be the object",
    "failed": "the model failed on it",
}


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
