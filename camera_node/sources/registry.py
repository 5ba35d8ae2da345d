"""Opens the sources of a scenario. Only the module of the kind in use is imported."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from camera_node.settings import (
    MODELS,
    LiveConfig,
    McapConfig,
    RecordedConfig,
    SourceConfig,
    WorldConfig,
    errors_of,
    own_class,
)
from camera_node.sources.base import Source
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from camera_node.synthetic.effects import Effects


def open_sources(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None = None,
    effects: Mapping[str, Effects | None] | None = None,
) -> dict[str, Source]:
    """Open the sources of ``cameras``, by camera; they share scene, data and devices where possible.

    data: folder of the data sets; None: $FRESHFIELD_DATA.
    effects: by camera; a source applies those of its camera.
    Raises ScenarioError, DatasetError, CameraError or ArmError; of a class from outside whatever it raises.
    """
    effects = effects or {}
    if scenario.held_out_every and scenario.held_out:
        from camera_node.sources.held_out_captures import check_divisible, divide

        check_divisible(scenario, config)
        whole = replace(scenario, cameras=scenario.training, held_out=())
        of_paths = {scenario.path_of(camera): effects.get(camera) for camera in cameras}
        return divide(scenario, open_sources(whole, config, list(of_paths), data, of_paths), cameras)
    if isinstance(config, WorldConfig):
        from camera_node.synthetic.source import open_sources as open_world

        return open_world(scenario, config, cameras, data, effects)
    sources: dict[str, Source]
    if config.kind not in MODELS:
        with errors_of(f"{scenario.path}: source"):
            own: Any = own_class(config.kind)[0]
            sources = {camera: own(scenario, config, camera) for camera in cameras}
    elif isinstance(config, RecordedConfig):
        from camera_node.sources.datasets.streamer import open_recorded

        sources = open_recorded(scenario, config, cameras, data)
    elif isinstance(config, LiveConfig):
        from camera_node.sources.devices.live import open_live

        sources = {**open_live(scenario, config, cameras)}
    else:
        from camera_node.sources.mcap import open_replay

        assert isinstance(config, McapConfig)
        sources = open_replay(scenario, config, cameras, data)
    for camera, made in effects.items():
        if made is not None and (made.image or made.pose or made.depth):
            from camera_node.sources.with_effects import AffectedSource

            if made.depth and not sources[camera].measures:
                raise ScenarioError(
                    f"{scenario.path}: source.effects: {camera} has no depth, which a depth sensor (kind depth) would "
                    "change: leave it out, or name those that have some in its cameras"
                )
            sources[camera] = AffectedSource(sources[camera], made, config.codec)
    return sources
