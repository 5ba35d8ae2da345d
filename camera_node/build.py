"""From a scenario to cameras that are ready to capture."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from camera_node.capture import Camera, ShotCache
from camera_node.config import SourceConfig
from camera_node.sources.registry import open_sources
from camera_node.sources.with_effects import camera_effects
from freshfield.scenario import Scenario


def build_cameras(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None = None,
    cache_bytes: int = 64 * 2**20,
) -> list[Camera]:
    """Open the sources of ``cameras``, in the scenario's order, with one cache for all.

    data: folder of the data sets, else $FRESHFIELD_DATA.
    cache_bytes: bound on compressed shots kept.

    Raises ScenarioError, DatasetError, CameraError or ArmError, each with one line for a person.
    """
    effects = {camera: camera_effects(scenario, config, camera) for camera in cameras}
    sources = open_sources(scenario, config, cameras, data, effects)
    cache = ShotCache(cache_bytes)
    clock_errors = {c: made for c, made in effects.items() if made is not None and made.clock}
    return [Camera(sources[c], config, cache, clock_errors.get(c)) for c in scenario.cameras if c in sources]
