"""The images of a COLMAP model, streamed as if cameras moved about what they show."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from camera_node.config import ColmapConfig, SourceConfig, find_data
from camera_node.sources import Source
from camera_node.sources.datasets.colmap import load_dataset
from camera_node.sources.datasets.photo import Look
from camera_node.sources.datasets.streamer import streams
from freshfield.scenario import Scenario


def open_sources(
    scenario: Scenario, config: SourceConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.open_sources``."""
    config = cast(ColmapConfig, config)
    look = Look(config.scale, config.background)
    dataset = load_dataset(find_data(config.data, scenario, data), look, config.images)
    return streams(scenario, config, cameras, dataset)
