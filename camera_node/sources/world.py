"""Cameras in the synthetic world: exact at any instant, repeating where the scene repeats."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import cast

from camera_node.config import SourceConfig, WorldConfig
from camera_node.sources import Shot, Source
from camera_node.sources.playback import rate
from camera_node.world import Scene, make_scene
from freshfield.geometry import Pose
from freshfield.scenario import Scenario, ScenarioError

WORLD_FPS = 15.0


class WorldSource:
    """One camera of a scene. Where the period is a whole number of ticks, as all periods are after a few
    rounds, the same shots come again and again."""

    def __init__(self, camera: str, scene: Scene, name: str, fps: Fraction) -> None:
        self.camera = camera
        self.fps = fps
        self.intrinsics, matrix = scene.cameras[name]
        self._pose = Pose.from_matrix(matrix)
        self._scene = scene
        self._name = name
        # N ticks last a whole number of periods for the smallest N that the reduced fraction names.
        period = Fraction(scene.period_s).limit_denominator(1000)
        self.contents: int | None = (period * fps).numerator if scene.moving else 1

    def content(self, tick: int) -> int:
        return tick if self.contents is None else tick % self.contents

    def read(self, content: int) -> Shot:
        image = self._scene.render(self._name, float(content / self.fps))
        return Shot(image, self._pose, self.intrinsics)


def open_sources(
    scenario: Scenario, config: SourceConfig, cameras: Sequence[str], data: Path | None
) -> dict[str, Source]:
    """See ``camera_node.sources.open_sources``; ``data`` is not needed."""
    config = cast(WorldConfig, config)
    where = f"{scenario.path}: source"
    try:
        scene = make_scene(config.scene, {"count": len(scenario.cameras), **config.scene_parameters()})
    except ValueError as error:
        raise ScenarioError(f"{where}: {error}") from None
    fps = rate(config.fps or WORLD_FPS)
    return {c: WorldSource(c, scene, name, fps) for c, name in _names(scenario, scene).items() if c in cameras}


def _names(scenario: Scenario, scene: Scene) -> dict[str, str]:
    """Scene camera of each scenario camera: the same name where all are known, else in order."""
    known = list(scene.cameras)
    if all(camera in known for camera in scenario.cameras):
        return {camera: camera for camera in scenario.cameras}
    if len(known) < len(scenario.cameras):
        raise ScenarioError(f"{scenario.path}: cameras: the scene has {len(known)}: {', '.join(known)}")
    return dict(zip(scenario.cameras, known))
