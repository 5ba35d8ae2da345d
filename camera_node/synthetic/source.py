"""Cameras in the synthetic world: exact at any instant, rendered ahead if the scene is periodic."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import cast

from camera_node.config import SourceConfig, WorldConfig, errors_of
from camera_node.sources.base import Shot, Source, rate
from camera_node.synthetic import Scene, make_scene
from camera_node.synthetic.effects import NO_EFFECTS, Effects
from camera_node.synthetic.frame_cache import FrameCache
from freshfield.geometry import Pose
from freshfield.scenario import Scenario, ScenarioError

WORLD_FPS = 15.0


class WorldSource(Source):
    """One camera of a scene, with its frames in a ``FrameCache``."""

    def __init__(self, camera: str, frames: FrameCache, effects: Effects) -> None:
        self.camera = camera
        self.fps, self.phase_ns = frames.fps, frames.phase_ns
        lens, matrix = frames.scene.cameras[frames.camera_id]
        self.intrinsics = effects.reported_lens(lens)
        # Frames with equal images but different reported poses are different shots.
        self.contents = None if effects.pose_varies else frames.contents
        self._pose = Pose.from_matrix(matrix)
        self._effects = effects
        self._frames = frames

    def content(self, tick: int) -> int:
        return tick if self.contents is None else self._frames.content(tick)

    def read(self, content: int) -> Shot:
        pose = self._effects.reported_pose(self._pose, content)
        return Shot(self._frames.read(self._frames.content(content)), pose, self.intrinsics)

    def prepare(self, stopped: Callable[[], bool]) -> None:
        self._frames.fill(stop=stopped)

    def release(self) -> None:
        # Replace the scene by the same one without its renderers.
        self._frames.scene = self._frames.scene.with_world(self._frames.scene.world)


def open_sources(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None,
    effects: Mapping[str, Effects | None],
) -> dict[str, Source]:
    """See ``camera_node.sources.registry.open_sources``; ``data`` is not needed."""
    config = cast(WorldConfig, config)
    if config.arm is not None and scenario.phase != "locked":
        raise ScenarioError(f"{scenario.path}: cameras.phase: an arm's cameras are locked to its poses")
    frames = frame_caches(scenario, config, cameras, effects)
    carried: dict[str, Source] = {}
    if config.arm is not None and any(camera in config.arm.cameras for camera in cameras):
        from camera_node.robot.flange_camera import open_flange_cameras

        on_hand = {camera: frames.pop(camera) for camera in cameras if camera in config.arm.cameras}
        carried = open_flange_cameras(scenario, config.arm, on_hand, effects)
    return carried | {
        camera: WorldSource(camera, each, effects.get(camera) or NO_EFFECTS) for camera, each in frames.items()
    }


def frame_caches(
    scenario: Scenario, config: WorldConfig, cameras: Sequence[str], effects: Mapping[str, Effects | None]
) -> dict[str, FrameCache]:
    """The frame cache of each camera; nothing is rendered yet. Raises ScenarioError."""
    with errors_of(f"{scenario.path}: source"):
        scene = make_scene(config.scene, {"count": len(scenario.cameras), **config.scene_parameters()})
    names = _scene_cameras(scenario, scene)
    with errors_of(f"{scenario.path}: source.effects"):  # of one that does not fit this scene
        return {
            camera: FrameCache(
                scene,
                names[camera],
                rate(config.fps or WORLD_FPS),
                effects=effects.get(camera) or NO_EFFECTS,
                codec=config.codec,
                quality=config.quality,
                # Training of a scheduler draws hundreds of motions, each used once.
                on_disk=config.motion_seed is None,
                phase_ns=scenario.phase_ns(camera, config.fps or WORLD_FPS),
            )
            for camera in cameras
        }


def _scene_cameras(scenario: Scenario, scene: Scene) -> dict[str, str]:
    """Scene camera of each scenario camera: by name if the scene has all of them, else in order."""
    known = list(scene.cameras)
    if all(camera in known for camera in scenario.cameras):
        return {camera: camera for camera in scenario.cameras}
    if len(known) < len(scenario.cameras):
        raise ScenarioError(f"{scenario.path}: cameras: the scene has {len(known)}: {', '.join(known)}")
    return dict(zip(scenario.cameras, known))
