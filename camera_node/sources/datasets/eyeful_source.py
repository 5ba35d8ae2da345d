"""An Eyeful Tower scene, streamed by the cameras of its rig: each steps through the positions of the tower.

Nothing in it moves, and images may be missing: cameras show their own images one after the other, not
necessarily of one position at a time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from camera_node.config import EyefulConfig, SourceConfig, find_data
from camera_node.sources import Source
from camera_node.sources.datasets.eyeful import load_dataset
from camera_node.sources.datasets.photo import Look
from camera_node.sources.datasets.streamer import streams
from freshfield.scenario import Scenario


def open_sources(
    scenario: Scenario, config: SourceConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.open_sources``."""
    config = cast(EyefulConfig, config)
    dataset = load_dataset(find_data(config.data, scenario, data), Look(config.scale), config.images)
    return streams(scenario, config, cameras, dataset, by_camera=True)
