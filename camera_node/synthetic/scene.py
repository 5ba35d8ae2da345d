"""Scenes: a world with cameras, bounds and a period, made by name from a dictionary of parameters.

A scene is one module beside this one with a dataclass ``Params`` and a function ``build``; it is
imported only when it is asked for.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from camera_node.synthetic.camera_rig import Rig
from camera_node.synthetic.motion import MAX_SPEED_M_PER_S
from camera_node.synthetic.render import CameraRenderer, Image, World
from camera_node.synthetic.shapes import Array
from freshfield.geometry import Pinhole
from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.scenario import ScenarioError, read_section

SCENES = ("room", "tile", "tower")
HELD_OUT = "cam00"
MAX_CAMERAS = 19
_RANGES = (
    ("count", 1, MAX_CAMERAS),
    ("width", 8, MAX_IMAGE_SIDE_PX),
    ("height", 8, MAX_IMAGE_SIDE_PX),
    ("horizontal_fov_deg", 5.0, 150.0),
    ("supersample", 1, 8),
)
# Parameters that decide nothing that stands still.
_OF_MOTION = ("speed_m_per_s", "motion_seed")
# Renderers from which others of the same still world are made: two rigs of cameras.
_STANDING_KEPT = 2 * MAX_CAMERAS
_STANDING: dict[tuple[str, str], CameraRenderer] = {}


class SceneError(ScenarioError):
    """A scene that cannot be made as asked; the message says what is valid."""


@dataclass(frozen=True)
class BaseParams:
    """Parameters every scene has.

    count: cameras including the held-out one, 1 to 19. width, height: pixels. supersample: rays per
    pixel side. distortion: OpenCV's (k1, k2, p1, p2) of every camera's lens.
    """

    count: int = 13
    width: int = 128
    height: int = 128
    horizontal_fov_deg: float = 60.0
    supersample: int = 2
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        for key, low, high in _RANGES:
            value = getattr(self, key)
            if not low <= value <= high:
                raise ValueError(f"{key} must be within {low} to {high}, got {value}")


@dataclass(frozen=True)
class MovingParams(BaseParams):
    """speed_m_per_s: mean speed of what moves; 0 stands still. motion_seed: draws another motion, each seed
    its own path, sense, start and speed (from 0.7 to 1.4 times the one given); None is the scene's own."""

    speed_m_per_s: float = 1.0
    motion_seed: int | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.speed_m_per_s != 0.0 and not 0.05 <= self.speed_m_per_s <= MAX_SPEED_M_PER_S:
            raise ValueError(f"speed_m_per_s must be 0 or within 0.05 to 8, got {self.speed_m_per_s}")
        if self.motion_seed is not None and self.motion_seed < 0:
            raise ValueError(f"motion_seed must be 0 or more, got {self.motion_seed}")


@dataclass(frozen=True)
class Scene:
    """A world seen by posed cameras.

    cameras: name -> (Pinhole, camera-to-world (4, 4)); cam00 is the held-out one. target: the point (3,)
    that they look at, or away from where they look outward. bounds: (2, 3), lower and upper corner in
    metres of everything that can be seen (an effect's occluder apart).
    period_s: the frames repeat after this long, a multiple of 0.6 s. moving: False where every instant is
    the same. stands: tells scenes apart by what stands still in them, for motions that are drawn: their
    renderers share what they hold of it.
    """

    name: str
    params: BaseParams
    cameras: Rig
    target: tuple[float, float, float]
    world: World
    bounds: Array
    period_s: float
    moving: bool = True
    stands: str | None = field(default=None, repr=False, compare=False)
    _renderers: dict[str, CameraRenderer] = field(default_factory=dict, repr=False, compare=False)

    @property
    def held_out(self) -> str:
        return HELD_OUT

    @property
    def background(self) -> tuple[float, float, float]:
        """Colour in [0, 1] of rays that meet nothing."""
        return self.world.background

    def render(self, camera_id: str, t_s: float) -> Image:
        """What a camera sees at an instant: uint8 RGB (height, width, 3), free of noise and exact."""
        return self.renderer(camera_id).image(t_s)

    def renderer(self, camera_id: str) -> CameraRenderer:
        """The camera's renderer, made on first use (some tenths of a second) and kept."""
        if camera_id not in self._renderers:
            if camera_id not in self.cameras:
                known = ", ".join(self.cameras)
                raise SceneError(f"scene {self.name}: no camera {camera_id!r}; it has {known}")
            self._renderers[camera_id] = self._shared(camera_id) or self.view(*self.cameras[camera_id])
        return self._renderers[camera_id]

    def _shared(self, camera_id: str) -> CameraRenderer | None:
        if self.stands is None:
            return None
        at = (self.stands, camera_id)
        if at not in _STANDING:
            while len(_STANDING) >= _STANDING_KEPT:
                _STANDING.pop(next(iter(_STANDING)))
            _STANDING[at] = self.view(*self.cameras[camera_id])
        return _STANDING[at].of(self.world)

    def view(self, camera: Pinhole, camera_to_world: Array) -> CameraRenderer:
        """A renderer for any other camera."""
        return CameraRenderer(self.world, camera, camera_to_world, self.params.supersample)

    def with_world(self, world: World, period_s: float, moving: bool) -> Scene:
        """The same cameras in another world (an effect adds to it)."""
        return dataclasses.replace(
            self, world=world, period_s=period_s, moving=moving, stands=None, _renderers={}
        )

    def with_cameras(self, cameras: Rig) -> Scene:
        """The same world through other cameras (an effect changes their lenses)."""
        return dataclasses.replace(self, cameras=cameras, stands=None, _renderers={})


def make_scene(name: str, params: Mapping[str, Any] | None = None) -> Scene:
    """The scene ``name`` with ``params`` over its defaults.

    Raises SceneError, listing what is valid, for an unknown scene or parameter or a value out of range.
    """
    if name not in SCENES:
        raise SceneError(f"unknown scene {name!r}; valid scenes: {', '.join(SCENES)}")
    module = importlib.import_module(f"camera_node.synthetic.scenes.{name}")
    scene: Scene = module.build(_checked(name, module.Params, params or {}))
    if getattr(scene.params, "motion_seed", None) is None:
        return scene
    still = {k: v for k, v in dataclasses.asdict(scene.params).items() if k not in _OF_MOTION}
    return dataclasses.replace(scene, stands=repr((name, still)))


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
    """The camera that ``params`` describe."""
    camera = Pinhole.from_fov(params.width, params.height, params.horizontal_fov_deg)
    return dataclasses.replace(camera, distortion=params.distortion)
