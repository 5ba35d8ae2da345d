"""Cameras in the synthetic world: exact at any instant, rendered ahead where the scene repeats."""

from __future__ import annotations

import logging
import pickle
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, cast

from camera_node.config import SourceConfig, WorldConfig
from camera_node.sources.base import Shot, Source
from camera_node.sources.playback import rate
from camera_node.synthetic import Scene, make_scene
from camera_node.synthetic.effects import NO_EFFECTS, EffectError
from camera_node.synthetic.frame_cache import FrameCache
from freshfield.geometry import Pose
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from camera_node.synthetic.effects import Effects

log = logging.getLogger("camera-node")

Stopped = Callable[[], bool]

WORLD_FPS = 15.0
# Casting takes some 350 bytes a ray at its peak. Beyond this many rays another process renders ahead, so
# that this one stays small.
_MAX_RAYS = 200_000
_POLL_S = 0.1


class WorldSource(Source):
    """One camera of a scene, with its frames kept by ``FrameCache``."""

    def __init__(
        self, camera: str, frames: FrameCache, effects: Effects, fill_elsewhere: Callable[[Stopped], None]
    ) -> None:
        self.camera = camera
        self.fps = frames.fps
        lens, matrix = frames.scene.cameras[frames.camera_id]
        self.intrinsics = effects.claimed_lens(lens)
        # Frames that look the same but claim different poses are different shots.
        self.contents = None if effects.pose_varies else frames.contents
        self._pose = Pose.from_matrix(matrix)
        self._effects = effects
        self._frames = frames
        self._fill_elsewhere = fill_elsewhere

    def content(self, tick: int) -> int:
        return tick if self.contents is None else self._frames.content(tick)

    def read(self, content: int) -> Shot:
        pose = self._effects.claimed_pose(self._pose, content)
        return Shot(self._frames.read(self._frames.content(content)), pose, self.intrinsics)

    def prepare(self, stopped: Stopped) -> None:
        rays = self.intrinsics.width * self.intrinsics.height * self._frames.scene.params.supersample**2
        if rays > _MAX_RAYS and self._frames.on_disk:
            self._fill_elsewhere(stopped)
        self._frames.fill(stop=stopped)

    def release(self) -> None:
        # The same scene without the renderers it has built so far.
        scene = self._frames.scene
        self._frames.scene = scene.with_world(scene.world, scene.period_s, scene.moving)


def open_sources(
    scenario: Scenario,
    config: SourceConfig,
    cameras: Sequence[str],
    data: Path | None,
    effects: Mapping[str, Effects | None],
) -> dict[str, Source]:
    """See ``camera_node.sources.registry.open_sources``; ``data`` is not needed."""
    config = cast(WorldConfig, config)
    frames = frame_caches(scenario, config, cameras, effects)
    carried: dict[str, Source] = {}
    if config.arm is not None and any(camera in config.arm.cameras for camera in cameras):
        from camera_node.robot.hand_camera import open_hand_cameras

        on_hand = {camera: frames.pop(camera) for camera in cameras if camera in config.arm.cameras}
        carried = open_hand_cameras(scenario, config.arm, on_hand, effects)
    return carried | {
        camera: WorldSource(
            camera,
            each,
            effects.get(camera) or NO_EFFECTS,
            partial(fill_in_child, scenario, config, camera),
        )
        for camera, each in frames.items()
    }


def frame_caches(
    scenario: Scenario, config: WorldConfig, cameras: Sequence[str], effects: Mapping[str, Effects | None]
) -> dict[str, FrameCache]:
    """The frames of each camera, none rendered yet. Raises ScenarioError."""
    try:
        scene = make_scene(config.scene, {"count": len(scenario.cameras), **config.scene_parameters()})
    except ValueError as error:
        raise ScenarioError(f"{scenario.path}: source: {error}") from None
    names = _names(scenario, scene)
    try:
        return {
            camera: FrameCache(
                scene,
                names[camera],
                rate(config.fps or WORLD_FPS),
                effects=effects.get(camera) or NO_EFFECTS,
                codec=config.codec,
                quality=config.quality,
                # A training draws hundreds of motions and sees none of them again.
                on_disk=config.motion_seed is None,
            )
            for camera in cameras
        }
    except EffectError as error:  # one that does not go with this scene
        raise ScenarioError(f"{scenario.path}: source.effects: {error}") from None


def _names(scenario: Scenario, scene: Scene) -> dict[str, str]:
    """Scene camera of each scenario camera: the same name where all are known, else in order."""
    known = list(scene.cameras)
    if all(camera in known for camera in scenario.cameras):
        return {camera: camera for camera in scenario.cameras}
    if len(known) < len(scenario.cameras):
        raise ScenarioError(f"{scenario.path}: cameras: the scene has {len(known)}: {', '.join(known)}")
    return dict(zip(scenario.cameras, known))


def fill_in_child(scenario: Scenario, config: WorldConfig, camera: str, stopped: Callable[[], bool]) -> None:
    """Have one camera's frames rendered by a process of its own, which takes its memory along: casting a
    large image takes hundreds of megabytes. Returns when the frames are there, when ``stopped`` says so, or
    when the child failed; frames that are missing then are rendered as they are needed."""
    log.info("%s: rendering its frames ahead, once: they are kept for next time", camera)
    begin = time.perf_counter()
    child = subprocess.Popen([sys.executable, "-m", "camera_node.synthetic.source"], stdin=subprocess.PIPE)
    try:
        assert child.stdin is not None
        try:
            with child.stdin:
                child.stdin.write(pickle.dumps((scenario, config, camera)))
        except BrokenPipeError:
            pass  # its exit status says the same
        while child.poll() is None and not stopped():
            time.sleep(_POLL_S)
    finally:
        child.terminate()
        status = child.wait()
    if status == 0:
        log.info("%s: frames are ready after %.1f s", camera, time.perf_counter() - begin)
    elif not stopped():
        log.warning("%s: rendering ahead failed (exit %d): frames are rendered as they come", camera, status)


def _child() -> None:
    scenario, config, camera = pickle.load(sys.stdin.buffer)
    from camera_node.sources.with_effects import camera_effects

    effects = {camera: camera_effects(scenario, config, camera)}
    frames = frame_caches(scenario, config, [camera], effects)[camera]
    frames.fill(stop=lambda: frames.disk_error is not None)
    if frames.disk_error is not None:
        sys.exit(f"camera-node: {frames.disk_error}")


if __name__ == "__main__":
    _child()
