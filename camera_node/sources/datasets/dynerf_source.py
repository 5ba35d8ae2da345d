"""DyNeRF's videos, streamed by live cameras at their own pace."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

from camera_node.config import DynerfConfig, SourceConfig, find_data
from camera_node.pose.providers import FixedPose, PoseProvider
from camera_node.sources import Source
from camera_node.sources.datasets.dynerf import load_rig
from camera_node.sources.datasets.video_source import rig_sources
from freshfield.scenario import Scenario


def open_sources(
    scenario: Scenario, config: SourceConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.open_sources``."""
    config = cast(DynerfConfig, config)
    folder = find_data(config.data, scenario, data)
    rig = load_rig(folder)

    def poses(_: str, name: str) -> PoseProvider:
        pose = rig.cameras[name].pose
        assert pose is not None  # each row of the file has one
        return FixedPose(pose)

    return rig_sources(scenario, config, cameras, rig, folder, poses)
