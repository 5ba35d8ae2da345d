"""Scenes: a world with cameras, bounds and a period, made by name from a dictionary of parameters.

A scene is a module in scenes/ with a dataclass ``Params`` and a function ``build``, imported on first use.
"""

from __future__ import annotations

import dataclasses
import importlib
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.bounds import Bounded, bounded
from camera_node.synthetic.camera_rig import PosedCameras
from camera_node.synthetic.motion import MAX_SPEED_M_PER_S
from camera_node.synthetic.placement import place_static
from camera_node.synthetic.render import CameraRenderer, Image, World, cast_rays
from freshfield.geometry import Array, Pinhole, world_rays
from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.scenario import ScenarioError, read_section

SCENES = ("room", "tile", "tower")
HELD_OUT = "cam00"
MAX_CAMERAS = 19
FOV_DEG = (5.0, 150.0)
# Parameters that do not change static parts.
_MOTION_PARAMETERS = ("speed_m_per_s", "motion_seed", "course", "people")
# Number of renderers kept for scenes with the same static parts: enough for two sets of cameras.
_MAX_STATIC_RENDERERS = 2 * MAX_CAMERAS
_STATIC_RENDERERS: dict[tuple[str, str], CameraRenderer] = {}


class SceneError(ScenarioError):
    """A scene that cannot be made from its parameters; the message says what is valid."""


@dataclass(frozen=True)
class BaseParams(Bounded):
    """Parameters every scene has.

    count: cameras including the held-out one, 1 to 19. width, height: pixels. supersample: rays per
    pixel side. distortion: OpenCV's (k1, k2, p1, p2) of every camera's lens.
    """

    count: int = bounded(13, 1, MAX_CAMERAS)
    width: int = bounded(128, 8, MAX_IMAGE_SIDE_PX)
    height: int = bounded(128, 8, MAX_IMAGE_SIDE_PX)
    horizontal_fov_deg: float = bounded(60.0, *FOV_DEG)
    supersample: int = bounded(2, 1, 8)
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


@dataclass(frozen=True)
class MovingParams(BaseParams):
    """speed_m_per_s: mean speed of moving parts; 0 stands still. motion_seed: draws a path, direction, start
    and speed (from 0.7 to 1.4 times the one given); None: the scene's own motion."""

    speed_m_per_s: float = 1.0
    motion_seed: int | None = bounded(None, 0, math.inf)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speed_m_per_s != 0.0 and not 0.05 <= self.speed_m_per_s <= MAX_SPEED_M_PER_S:
            raise ValueError(f"speed_m_per_s must be 0 or within 0.05 to 8, got {self.speed_m_per_s}")


@dataclass(frozen=True)
class Scene:
    """A world seen by posed cameras.

    cameras: name -> (Pinhole, camera-to-world (4, 4)); cam00 is held out.
    target: (3,), the point that cameras look at, or away from.
    bounds: (2, 3), lower and upper corner in meters of everything that can be seen, except an occluder.
    period_s: time after which frames repeat, a multiple of 0.6 s.
    moving: False if all instants look the same.
    object_parts: number of static parts, from the first, that form the object of interest; None: all.
    static_key: identifies the static parts of scenes with a motion_seed, whose renderers share their static
        images; None for others.
    """

    name: str
    params: BaseParams
    cameras: PosedCameras
    target: tuple[float, float, float]
    world: World
    bounds: Array
    period_s: float
    moving: bool = True
    object_parts: int | None = None
    static_key: str | None = field(default=None, repr=False, compare=False)
    _renderers: dict[str, CameraRenderer] = field(default_factory=dict, repr=False, compare=False)

    def render(self, camera_id: str, t_s: float) -> Image:
        """A camera's image at an instant: uint8 RGB (height, width, 3), exact and free of noise."""
        return self.renderer(camera_id).image(t_s)

    def renderer(self, camera_id: str) -> CameraRenderer:
        """The camera's renderer, made on first use (which takes tenths of a second) and kept. Raises
        SceneError for an unknown camera."""
        if camera_id not in self._renderers:
            if camera_id not in self.cameras:
                known = ", ".join(self.cameras)
                raise SceneError(f"scene {self.name}: no camera {camera_id!r}; it has {known}")
            self._renderers[camera_id] = self._shared_renderer(camera_id) or self.view(*self.cameras[camera_id])
        return self._renderers[camera_id]

    def _shared_renderer(self, camera_id: str) -> CameraRenderer | None:
        if self.static_key is None:
            return None
        at = (self.static_key, camera_id)
        if at not in _STATIC_RENDERERS:
            while len(_STATIC_RENDERERS) >= _MAX_STATIC_RENDERERS:
                _STATIC_RENDERERS.pop(next(iter(_STATIC_RENDERERS)))
            _STATIC_RENDERERS[at] = self.view(*self.cameras[camera_id])
        return _STATIC_RENDERERS[at].for_world(self.world)

    def view(self, camera: Pinhole, camera_to_world: Array) -> CameraRenderer:
        """A renderer for any camera. camera_to_world: (4, 4)."""
        return CameraRenderer(self.world, camera, camera_to_world, self.params.supersample)

    def object_mask(self, camera: Pinhole, camera_to_world: Array) -> NDArray[np.bool_]:
        """Which pixels (H, W) of a camera show the object (``object_parts``), by the rays through their
        centers; moving parts are ignored."""
        origin, rays = world_rays(camera, camera_to_world)
        rays = np.ascontiguousarray(rays.reshape(-1, 3).T)
        placed = place_static(self.world.static_parts)
        _, which = cast_rays(origin, rays, placed, np.full(rays.shape[1], np.inf))
        count = len(placed.parts) if self.object_parts is None else self.object_parts
        return np.asarray(((which >= 0) & (which < count)).reshape(camera.height, camera.width))

    def with_world(self, world: World, period_s: float | None = None, moving: bool | None = None) -> Scene:
        """The same cameras in another world, as effects need it. period_s, moving: None keeps them."""
        period_s = self.period_s if period_s is None else period_s
        moving = self.moving if moving is None else moving
        return dataclasses.replace(self, world=world, period_s=period_s, moving=moving, static_key=None, _renderers={})

    def with_cameras(self, cameras: PosedCameras) -> Scene:
        """The same world with other cameras, as effects on lenses need it."""
        return dataclasses.replace(self, cameras=cameras, static_key=None, _renderers={})


def make_scene(name: str, params: Mapping[str, Any] | None = None) -> Scene:
    """Make the scene ``name``, one of SCENES. params: override its defaults.

    Raises SceneError, listing what is valid, for an unknown scene or parameter or a value out of range.
    """
    if name not in SCENES:
        raise SceneError(f"unknown scene {name!r}; valid scenes: {', '.join(SCENES)}")
    module = importlib.import_module(f"camera_node.synthetic.scenes.{name}")
    scene: Scene = module.build(_checked(name, module.Params, params or {}))
    if getattr(scene.params, "motion_seed", None) is None:
        return scene
    still = {k: v for k, v in dataclasses.asdict(scene.params).items() if k not in _MOTION_PARAMETERS}
    return dataclasses.replace(scene, static_key=repr((name, still)))


def _checked(name: str, model: type[Any], given: Mapping[str, Any]) -> Any:
    known = {f.name: f.default for f in dataclasses.fields(model)}
    for key in given:
        if key not in known:
            valid = ", ".join(f"{k} ({v})" for k, v in known.items())
            raise SceneError(f"scene {name}: unknown parameter {key!r}; valid (default): {valid}")
    try:
        return read_section(model, dict(given), f"scene {name}")
    except ScenarioError as error:
        raise SceneError(str(error)) from None


def pinhole(params: BaseParams) -> Pinhole:
    """The lens that ``params`` describe."""
    camera = Pinhole.from_fov(params.width, params.height, params.horizontal_fov_deg)
    return dataclasses.replace(camera, distortion=params.distortion)
