"""The scenario's ``source:`` section: what the cameras look at, how fast, and how frames are compressed.

``kind`` chooses the model. Every key is checked here, with file and key in the message; what needs the data
itself (does the folder hold this camera?) is checked when the source opens.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from freshfield.payload import CODECS
from freshfield.scenario import Scenario, ScenarioError, read_section

KINDS = ("world", "transforms", "video")
LOOPS = ("back-and-forth", "restart")
PAIRINGS = ("nearest", "interpolated")
BACKGROUNDS = ("white", "black", "keep")


@dataclass(frozen=True)
class SourceConfig:
    """Keys of every kind.

    fps: captures a second (default: the recording's own, 15 for a world, 10 for photos). codec: jpeg, png
    or zstd. quality: of jpeg, 1 to 100; colour is not subsampled from 90 up. effects: name -> parameters;
    what is not listed is not imported.
    """

    kind: str
    fps: float | None = None
    codec: str = "jpeg"
    quality: int = 92
    effects: dict[str, dict[str, Any] | None] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.fps is not None and not 0.01 <= self.fps <= 1000:
            raise ValueError(f"fps is {self.fps:g}, expected 0.01 to 1000")
        if self.codec not in CODECS:
            raise ValueError(f"codec is {self.codec!r}, expected one of {', '.join(CODECS)}")
        if not 1 <= self.quality <= 100:
            raise ValueError(f"quality is {self.quality}, expected 1 to 100")

    @property
    def effect_parameters(self) -> dict[str, dict[str, Any]]:
        """Effects with their parameters; a bare name in the file means no parameters."""
        return {name: dict(parameters or {}) for name, parameters in self.effects.items()}


@dataclass(frozen=True)
class WorldConfig(SourceConfig):
    """A synthetic world. scene: ``room``, ``tile`` or ``tower``; size and lens of its cameras; how fast it
    moves. params: further parameters of the scene by name."""

    scene: str = "room"
    width: int | None = None
    height: int | None = None
    horizontal_fov_deg: float | None = None
    speed_m_per_s: float | None = None
    params: dict[str, Any] = field(default_factory=dict)

    def scene_parameters(self) -> dict[str, Any]:
        """What the scene is made with: the keys above that were given, and ``params``."""
        names = ("width", "height", "horizontal_fov_deg", "speed_m_per_s")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return {**given, **self.params}


@dataclass(frozen=True)
class TrajectoryConfig:
    """Poses from TUM files (``t tx ty tz qx qy qz qw``), one a camera, instead of the calibration's.

    files: camera -> file. pairing: nearest or interpolated. max_gap_ms: a frame further than this from its
    pose sample is not sent. start_s: the trajectory's time at the clip's first frame.
    """

    files: dict[str, str]
    pairing: str = "interpolated"
    max_gap_ms: float = 50.0
    start_s: float = 0.0

    def __post_init__(self) -> None:
        if self.pairing not in PAIRINGS:
            raise ValueError(f"pairing is {self.pairing!r}, expected one of {', '.join(PAIRINGS)}")
        if self.max_gap_ms < 0:
            raise ValueError("max_gap_ms cannot be negative")


@dataclass(frozen=True)
class RecordedConfig(SourceConfig):
    """Keys of both recorded kinds. data: folder or JSON, absolute or below the data folder. scale: images
    are divided by it. loop: clips go back and forth, or restart. assignment: scenario camera -> the data
    set's camera, where the names differ."""

    data: str = ""
    scale: float = 1.0
    loop: str = "back-and-forth"
    assignment: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.data:
            raise ValueError("data: missing: the data set's folder or JSON file")
        if self.scale < 1:
            raise ValueError(f"scale is {self.scale:g}, expected 1 or more (2 halves the images)")
        if self.loop not in LOOPS:
            raise ValueError(f"loop is {self.loop!r}, expected one of {', '.join(LOOPS)}")


@dataclass(frozen=True)
class TransformsConfig(RecordedConfig):
    """nerfstudio, instant-ngp, NeRF-synthetic. background: what RGBA images are laid on; ``keep`` sends
    alpha and needs the codec png."""

    background: str = "white"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.background not in BACKGROUNDS:
            raise ValueError(f"background is {self.background!r}, expected {', '.join(BACKGROUNDS)}")
        if self.background == "keep" and self.codec != "png":
            raise ValueError(f"background 'keep' sends alpha, which codec {self.codec!r} cannot; use png")


@dataclass(frozen=True)
class VideoConfig(RecordedConfig):
    """Video files with a calibration JSON. data: the JSON, or the folder that holds it. files: camera ->
    video, relative to the JSON (default ``videos/<camera>.mp4`` or ``<camera>.mp4``)."""

    files: dict[str, str] = field(default_factory=dict)
    trajectory: TrajectoryConfig | None = None


MODELS: dict[str, type[SourceConfig]] = {
    "world": WorldConfig,
    "transforms": TransformsConfig,
    "video": VideoConfig,
}


def source_config(scenario: Scenario) -> SourceConfig:
    """The checked ``source:`` section. Raises ScenarioError."""
    where = f"{scenario.path}: source"
    kind = scenario.source.get("kind")
    if kind not in MODELS:
        raise ScenarioError(f"{where}.kind: expected one of {', '.join(KINDS)}, got {kind!r}")
    return read_section(MODELS[kind], scenario.source, where)


def find_data(name: str, scenario: Scenario, base: Path | None) -> Path:
    """The file or folder ``name`` of the ``data`` key: absolute, or below ``base`` (--data), else below
    $FRESHFIELD_DATA. Raises ScenarioError saying what to set."""
    where = f"{scenario.path}: source.data"
    path = Path(name).expanduser()
    if not path.is_absolute():
        folder = base or (Path(os.environ["FRESHFIELD_DATA"]) if os.environ.get("FRESHFIELD_DATA") else None)
        if folder is None:
            raise ScenarioError(
                f"{where}: {name!r} is looked for in the data folder: give --data DIR or set FRESHFIELD_DATA"
            )
        path = folder / path
    if not path.exists():
        raise ScenarioError(
            f"{where}: {path} does not exist; --data or FRESHFIELD_DATA names the folder above"
        )
    return path
