"""A data set with a transforms JSON, streamed by live cameras."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from camera_node.config import SourceConfig, TransformsConfig, find_data
from camera_node.sources import Source
from camera_node.sources.datasets.streamer import streams
from camera_node.sources.datasets.transforms import load_dataset
from freshfield.scenario import Scenario


def open_sources(
    scenario: Scenario, config: SourceConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.open_sources``."""
    config = cast(TransformsConfig, config)
    dataset = load_dataset(find_data(config.data, scenario, data), config.scale, config.background)
    return streams(scenario, config, cameras, dataset)
