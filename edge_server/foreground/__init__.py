"""Foreground segmentation of images before the field is trained (thesis 4.4.3).

A YOLO segmentation model detects the object and labels its pixels; the mask within the box stays, and the
background becomes transparent, which supervises the field with empty space there. Poses do not change. The
scenario key ``edge.foreground`` enables it; without that key this package is not imported. Held-out frames
are not masked: fidelity is measured on whole images, background included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from freshfield.scenario import read_section

MODELS = Path(__file__).parent / "models"
# The segmentation models that we ship, by the name of the object: the file in ``MODELS``.
SHIPPED = {"tile": "tile_int8.onnx"}
# Why an image is used whole, by the name of its count in ``foreground.Counts``.
WHY = {
    "not_detected": "nothing was found in it",
    "empty_box": "the box has no area within it",
    "empty_mask": "no pixel of the box was found to be the object",
    "full_mask": "all of it was found to be the object",
    "failed": "the model failed on it",
}


class ForegroundError(ValueError):
    """A model or setting is unusable; the one-line message says what, where and what to do."""


@dataclass(frozen=True)
class ForegroundConfig:
    """The section ``edge.foreground`` of a scenario.

    detector: YOLO segmentation ONNX (v8, v11), relative to the scenario, or ``tile``, the shipped model of
    the tile.
    kinds: class names to detect; none: any.
    confidence: minimum score, 0 to 1; of several detections the surest counts.
    margin: added to each side of a detected box, as a share of it, 0 to 1.
    """

    detector: str
    kinds: list[str] = field(default_factory=list)
    confidence: float = 0.25
    margin: float = 0.05

    def __post_init__(self) -> None:
        for name in ("confidence", "margin"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name}: expected 0 to 1, got {getattr(self, name)}")


def read_foreground(mapping: Mapping[str, Any], scenario: Path) -> ForegroundConfig:
    """Read the section ``edge.foreground`` of file ``scenario``; raises freshfield.scenario.ScenarioError."""
    values = dict(mapping) if isinstance(mapping, Mapping) else mapping
    config = read_section(ForegroundConfig, values, f"{scenario}: edge.foreground")
    if config.detector in SHIPPED:
        return config
    return replace(config, detector=str(scenario.parent / config.detector))
