"""Cameras in the synthetic world: exact at any instant, rendered ahead if the scene is periodic."""

from __future__ import annotations

import dataclasses
import hashlib
import math
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, cast

import msgspec
import numpy as np

from camera_node.settings import WORLD_FPS, SourceConfig, WorldConfig, errors_of
from camera_node.sources.base import Shot, Source, pixels, rate
from camera_node.synthetic import Scene, make_scene
from camera_node.synthetic.effects import NO_EFFECTS, Effects
from camera_node.synthetic.frame_cache import FrameCache, default_folder, renderer_version
from camera_node.synthetic.motion import PERIOD_UNIT_S
from camera_node.synthetic.render import CameraRenderer, Image
from camera_node.synthetic.synthetic_constants import WORLD_MAX_FRAMES
from freshfield import payload
from freshfield.depth import DepthImage
from freshfield.geometry import Array, Pose
from freshfield.scenario import Scenario, ScenarioError

if TYPE_CHECKING:
    from camera_node.robot.flange_camera import FlangeMotion
    from camera_node.synthetic.depth import DepthRenderer
    from camera_node.synthetic.walk import Walk

    Carrier = Walk | FlangeMotion


class WorldSource(Source):
    """One camera of a scene. Frame k shows the scene at k / fps + phase_ns.

    camera, camera_id: names in the scenario and in the scene.
    effects: of this camera, from ``load_effects``.
    codec, quality: of the encoded frames.
    folder: root of the cache of rendered frames; None renders every frame anew.
    carrier: moves the camera, instead of the scene's pose, and repeats after its ``lap_s``; None: it stands still.
    Raises ValueError for a rate that is not positive.

    Attributes:
    repeats_after: frames until the scene repeats (1 for a static scene); None for more than WORLD_MAX_FRAMES.
    cache: of the frames; None if they are rendered anew.
    """

    def __init__(
        self,
        camera: str,
        scene: Scene,
        camera_id: str,
        fps: float | Fraction,
        *,
        effects: Effects = NO_EFFECTS,
        codec: str = "jpeg",
        quality: int = 92,
        phase_ns: int = 0,
        folder: Path | None = None,
        carrier: Carrier | None = None,
    ) -> None:
        self.scene = scene
        self.camera, self.camera_id, self.phase_ns = camera, camera_id, phase_ns
        self.fps = Fraction(fps).limit_denominator(1001)
        if self.fps <= 0:
            raise ValueError(f"fps must be positive, got {fps}")
        self.intrinsics, matrix = self.scene.cameras[camera_id]
        self._carrier, self._size = carrier, (self.intrinsics.width, self.intrinsics.height)
        self._moves = bool(effects.mount) or carrier is not None
        periods_s = [scene.period_s] if scene.moving else []
        if self._moves:
            periods_s.append(math.inf if carrier is None or carrier.lap_s is None else carrier.lap_s)
        self.repeats_after = _repeats_after(periods_s, self.fps)
        # Frames with equal images but different reported poses are different shots.
        self.contents = None if effects.image or effects.pose_varies else self.repeats_after
        self._pose, self._effects = Pose.from_matrix(matrix), effects
        # Frames to which image effects are applied later are stored losslessly.
        self._codec, self._quality = "zstd" if effects.image else codec, quality
        self._depth: DepthRenderer | None = None
        self._placed: tuple[Array, CameraRenderer] | None = None
        self.cache: FrameCache | None = None
        if folder is not None and self.repeats_after is not None:
            self.cache = FrameCache(self.key(), self._codec, self._size, folder)

    def content(self, tick: int) -> int:
        return tick % self.contents if self.contents else tick

    def read(self, content: int) -> Shot:
        """Shot number ``content``: encoded or, if there are image effects, an image still to be encoded."""
        frame = content % self.repeats_after if self.repeats_after else content
        image: Image | bytes
        if self._effects.image:
            if self.cache is None:
                exact = self._render(frame)
            else:
                exact = payload.decode(self._stored(frame), self._codec, *self._size)
            image = self._effects.apply(exact, content, self._time_s(content))
        else:
            image = self._stored(frame)
        t_s, pose, gap_ns = self._time_s(content), self._pose, 0
        if self._carrier is not None:
            pose, gap_ns = self._carrier.measured(self._effects.pose_instant_s(t_s))
        return Shot(image, self._effects.reported_pose(pose, content, t_s), self.intrinsics, gap_ns)

    def depth(self, content: int, shot: Shot) -> DepthImage | None:
        """As the listed depth sensor measures it. Of a scene that repeats, measurements repeat too."""
        if not self._effects.depth:
            return None
        frame = content % self.repeats_after if self.repeats_after else content
        if self._depth is None or self._moves:
            from camera_node.synthetic.depth import DepthRenderer

            self._depth = DepthRenderer(self.scene.world, self.intrinsics, self._true_pose(frame))
        exact = self._depth.depth(self._time_s(frame))
        return self._effects.depth[0].measure(exact, pixels(shot, self._codec), self.intrinsics, content)

    def prepare(self, stopped: Callable[[], bool]) -> None:
        for frame in range(self.repeats_after or 0):
            if stopped() or self.cache is None or self.cache.error is not None:
                break
            self._stored(frame)

    def release(self) -> None:
        # Replace the scene by the same one without its renderers.
        self._depth = self._placed = None
        self.scene = dataclasses.replace(self.scene)

    def key(self) -> str:
        """Hash (hex) of everything that determines the frames' bytes."""
        lens, pose = self.scene.cameras[self.camera_id]
        # ``count`` determines which cameras there are, not what one of them sees.
        shown = (
            self.scene.name,
            msgspec.structs.replace(self.scene.params, count=1),
            lens,
            pose.tolist(),
            self._carrier,
        )
        codec = (self._codec, self._quality if self._codec == "jpeg" else None)
        what = repr((shown, codec, self.fps, self.phase_ns, renderer_version()))
        return hashlib.sha256(what.encode()).hexdigest()

    def _stored(self, frame: int) -> bytes:
        """The frame, encoded: from the cache, or rendered and kept there."""
        data = None if self.cache is None else self.cache.load(frame)
        if data is None:
            data = payload.encode(self._render(frame), self._codec, self._quality)
            if self.cache is not None:
                self.cache.save(frame, data)
        return data

    def _render(self, frame: int) -> Image:
        view = self._view(self._true_pose(frame)) if self._moves else self.scene.renderer(self.camera_id)
        return view.image(self._time_s(frame))

    def _true_pose(self, frame: int) -> Array:
        t_s = self._time_s(frame)
        if self._carrier is not None:
            return self._carrier.pose(t_s)
        return self._effects.placed(self.scene.cameras[self.camera_id][1], t_s)

    def _view(self, at: Array) -> CameraRenderer:
        """A renderer of a camera that stands there, kept until it stands elsewhere; of a carried one it is not kept."""
        if self._carrier is not None:
            return self.scene.view(self.intrinsics, at)
        if self._placed is None or not np.array_equal(self._placed[0], at):
            self._placed = at, self.scene.view(self.intrinsics, at)
        return self._placed[1]

    def _time_s(self, frame: int) -> float:
        return float(frame / self.fps) + self.phase_ns / 1e9


def _repeats_after(periods_s: Sequence[float], fps: Fraction) -> int | None:
    if math.inf in periods_s:
        return None
    if not periods_s:
        return 1
    period = math.lcm(*(round(s / PERIOD_UNIT_S) for s in periods_s)) * Fraction(PERIOD_UNIT_S).limit_denominator(10)
    # The numerator is the least number of frames that take a whole number of periods.
    frames = (period * fps).numerator
    return frames if frames <= WORLD_MAX_FRAMES else None


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
    with errors_of(f"{scenario.path}: source"):
        scene = make_scene(config.scene, {"count": len(scenario.cameras), **config.scene_parameters()})
    names = _scene_cameras(scenario, scene)
    still: dict[str, Array] = {}
    if config.arm is not None:
        from camera_node.robot.arm.camera_poses import watching

        still = watching(scenario, config.arm, cameras)
    if still:
        placed = {names[camera]: (scene.cameras[names[camera]][0], pose) for camera, pose in still.items()}
        scene = dataclasses.replace(scene, cameras={**scene.cameras, **placed}, static_key=None)
    # Training of a scheduler draws hundreds of motions, each used once.
    folder = default_folder() if config.motion_seed is None else None
    fps, carriers = config.fps or WORLD_FPS, _carriers(scenario, config, scene, [c for c in cameras if c not in still])
    return {
        camera: WorldSource(
            camera,
            scene,
            names[camera],
            rate(fps),
            effects=effects.get(camera) or NO_EFFECTS,
            codec=config.codec,
            quality=config.quality,
            phase_ns=scenario.phase_ns(camera, fps),
            folder=folder,
            carrier=carriers.get(camera),
        )
        for camera in cameras
    }


def _carriers(scenario: Scenario, config: WorldConfig, scene: Scene, cameras: Sequence[str]) -> dict[str, Carrier]:
    """What carries each camera that is carried. Connects to an arm that carries one. Raises ScenarioError and
    ArmError."""
    carriers: dict[str, Carrier] = {}
    on_arm = [camera for camera in cameras if config.arm is not None and camera in config.arm.cameras]
    if config.arm is not None and on_arm:
        from camera_node.robot.flange_camera import open_flange

        carriers.update(open_flange(scenario, config.arm, on_arm))
    if not config.carried:
        return carriers
    from camera_node.synthetic.walk import walks_through

    unknown = [camera for camera in config.carried if camera not in scenario.cameras]
    if unknown or (config.arm is not None and set(config.carried) & set(config.arm.cameras)):
        raise ScenarioError(
            f"{scenario.path}: source.carried: expected cameras of this scenario that no arm carries, "
            f"got {', '.join(unknown or config.carried)}"
        )
    with errors_of(f"{scenario.path}: source.carried"):
        return {**carriers, **walks_through(scene, config.carried)}


def _scene_cameras(scenario: Scenario, scene: Scene) -> dict[str, str]:
    """Scene camera of each scenario camera: by name if the scene has all of them, else in order."""
    known = list(scene.cameras)
    if all(camera in known for camera in scenario.cameras):
        return {camera: camera for camera in scenario.cameras}
    if len(known) < len(scenario.cameras):
        raise ScenarioError(f"{scenario.path}: cameras: the scene has {len(known)}: {', '.join(known)}")
    return dict(zip(scenario.cameras, known))
