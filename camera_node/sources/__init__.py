"""Where frames come from. One file a source; adding one is one file here and one line in ``config``."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.config import SourceConfig
from freshfield.geometry import Pinhole, Pose
from freshfield.scenario import Scenario

if TYPE_CHECKING:
    from camera_node.synthetic.effects import Effects


@dataclass(frozen=True)
class Shot:
    """What a camera saw at one instant.

    image: uint8 (H, W, 3) RGB or (H, W, 4) RGBA, or bytes already in the scenario's codec; matches
    ``intrinsics``. pose_gap_ns: time between the exposure and the pose sample it was paired with.
    captured_ns: when a real camera exposed it, on the node's clock; None: at the tick it was asked for.
    """

    image: NDArray[np.uint8] | bytes
    pose: Pose
    intrinsics: Pinhole
    pose_gap_ns: int = 0
    captured_ns: int | None = None


class Source(Protocol):
    """One camera. Tick k is the instant k / fps; tick 0 is the start of the epoch, so that cameras in
    different processes look at the same world."""

    camera: str
    fps: Fraction
    intrinsics: Pinhole
    contents: int | None
    """How many different shots there are before they repeat; None if they never do."""

    def content(self, tick: int) -> int:
        """Which shot a tick shows, 0 .. contents - 1; the tick itself where nothing repeats."""
        ...

    def read(self, content: int) -> Shot:
        """Render, read or decode one shot. Raises ValueError (DatasetError, PoseGapError) if it cannot be
        had; later ones may still."""
        ...

    def prepare(self, stopped: Callable[[], bool]) -> None:
        """Make ahead what makes ``read`` fast; takes as long as it takes, or until ``stopped()``."""
        ...

    def release(self) -> None:
        """Let go of what making shots takes (decoders, renderers); ``read`` gets it again."""
        ...


# kind of the scenario's source -> the module that opens it
_MODULES = {
    "world": "camera_node.synthetic.source",
    "mcap": "camera_node.sources.mcap",
    **{kind: f"camera_node.sources.devices.{kind}" for kind in ("oak", "realsense")},
    "camera": "camera_node.sources.devices.opencv",
    **{
        kind: f"camera_node.sources.datasets.{kind}_source"
        for kind in ("transforms", "video", "dynerf", "zju", "eyeful", "colmap")
    },
}


def source_module(kind: str) -> str:
    """Name of the module that opens sources of ``kind``."""
    return _MODULES[kind]


def open_sources(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None = None,
    effects: Mapping[str, Effects | None] | None = None,
) -> dict[str, Source]:
    """The sources of ``cameras``, sharing what can be shared, with each camera's effects. Only the file of
    the kind in use is imported. Raises ScenarioError or DatasetError."""
    module: Any = importlib.import_module(source_module(config.kind))
    effects = effects or {}
    if config.kind == "world":
        return module.open_sources(scenario, config, cameras, data, effects)
    sources: dict[str, Source] = module.open_sources(scenario, config, cameras, data)
    for camera, made in effects.items():
        if made is not None and (made.image or made.pose):
            from camera_node.sources.with_effects import AffectedSource

            sources[camera] = AffectedSource(sources[camera], made, config.codec)
    return sources
