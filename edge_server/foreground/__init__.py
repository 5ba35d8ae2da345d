"""Foreground segmentation of images before the field is trained (thesis 4.4.3).

detector -> box -> segmentation -> alpha. A detector finds the object's box, a segmenter labels the pixels
in it, and the background becomes transparent, which supervises the field with empty space there. Poses do
not change. The scenario key ``edge.foreground`` enables it; without that key this package is not imported.
Held-out frames are not masked: fidelity is measured on whole images, background included.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from freshfield.scenario import read_section

DEFAULT, TILE, GRABCUT, BOX, OWN = "default", "tile", "grabcut", "box", "detector"
MODELS = Path(__file__).parent / "models"
# A detector that we ship for one object, by name: its file in ``MODELS``.
OBJECTS = {TILE: "tile_int8.onnx"}
# Why an image is used whole, by the name of its count in ``foreground.Counts``.
WHY = {
    "not_detected": "nothing was found in it",
    "empty_box": "the box has no area within it",
    "empty_mask": "no pixel of the box was found to be the object",
    "full_mask": "all of it was found to be the object",
    "failed": "the model failed on it",
}
Four = tuple[float, float, float, float]


class ForegroundError(ValueError):
    """A model or setting is unusable; the one-line message says what, where and what to do."""


@dataclass(frozen=True)
class ForegroundConfig:
    """The section ``edge.foreground`` of a scenario.

    detector: YOLO detection or segmentation ONNX (v8, v11), relative to the scenario, or a shipped one:
    ``tile`` finds the tile and gives its masks (``edge-server train-detector --of tile``), ``default``
    people, carts, balls and drums of our scenes.
    box: [left, top, right, bottom] as shares of the image, instead of a detector. boxes: one per camera.
    kinds: class names to detect; none: any.
    confidence: minimum score; of several detections the surest counts.
    margin: added to each side of a detected box, as a share of it.
    segment: ``detector`` (its own masks, of a segmentation model), ``grabcut`` or ``box`` (the whole box);
    none: the detector's masks if it has some, else grabcut.
    iterations: number of grabcut iterations.
    side: longest side, pixels, that grabcut works at; the mask is then enlarged.
    doubt: supervision weight, 0 to 1, of background pixels within the box, against 1 outside: a false hole in
    the object contradicts all other views, an unsupervised pixel does not.
    """

    detector: str | None = None
    box: Four | None = None
    boxes: dict[str, Four] = field(default_factory=dict)
    kinds: list[str] = field(default_factory=list)
    confidence: float = 0.25
    margin: float = 0.05
    segment: str | None = None
    iterations: int = 3
    side: int = 160
    doubt: float = 0.0

    def __post_init__(self) -> None:
        fixed = bool(self.boxes) or self.box is not None
        if fixed == (self.detector is not None):
            raise ValueError("expected either detector or box (or boxes)")
        for name, box in {**({"box": self.box} if self.box else {}), **self.boxes}.items():
            if not all(0.0 <= v <= 1.0 for v in box):
                raise ValueError(f"{name}: expected left, top, right, bottom within 0 to 1, got {list(box)}")
        ranges = {
            "confidence": (0.0, 1.0),
            "margin": (0.0, 1.0),
            "iterations": (1, 50),
            "side": (16, 4096),
            "doubt": (0.0, 1.0),
        }
        for name, (low, high) in ranges.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name}: expected {low:g} to {high:g}, got {getattr(self, name)}")
        if self.segment not in (None, OWN, GRABCUT, BOX):
            raise ValueError(f"segment: expected {OWN} or {GRABCUT} or {BOX}, got {self.segment!r}")


def read_foreground(mapping: Mapping[str, Any], scenario: Path) -> ForegroundConfig:
    """Read the section ``edge.foreground`` of file ``scenario``; raises freshfield.scenario.ScenarioError."""
    values = dict(mapping) if isinstance(mapping, Mapping) else mapping
    config = read_section(ForegroundConfig, values, f"{scenario}: edge.foreground")
    if config.detector in (None, DEFAULT, *OBJECTS):
        return config
    return replace(config, detector=str(scenario.parent / str(config.detector)))
