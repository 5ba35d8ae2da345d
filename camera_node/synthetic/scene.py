"""Scenes: a world with cameras, bounds and a period, made by name from a dictionary of parameters.

A scene is a module in scenes/ with a dataclass ``Params`` and a function ``build``, imported on first use.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from camera_node.synthetic.camera_rig import PosedCameras
from camera_node.synthetic.render import CameraRenderer, Image, World
from camera_node.synthetic.scene_parameters import MAX_CAMERAS, BaseParams
from freshfield.geometry import Array, Pinhole
from freshfield.settings import ScenarioError, as_mapping, read_settings

SCENES = ("drawn_room", "room", "tile", "tower")
HELD_OUT = "cam00"
# Parameters that do not change static parts.
_MOTION_PARAMETERS = ("speed_m_per_s", "motion_seed", "people")
# Number of renderers kept for scenes with the same static parts: enough for two sets of cameras.
_MAX_STATIC_RENDERERS = 2 * MAX_CAMERAS
_STATIC_RENDERERS: dict[tuple[str, str], CameraRenderer] = {}


@dataclass(frozen=True)
class Scene:
    """A world seen by posed cameras.

    cameras: name -> (Pinhole, camera-to-world (4, 4)); cam00 is held out.
    target: (3,), the point that cameras look at, or away from.
    bounds: (2, 3), lower and upper corner in meters of everything that can be seen.
    period_s: time after which frames repeat, a multiple of 0.6 s.
    moving: False if all instants look the same.
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
    static_key: str | None = field(default=None, repr=False, compare=False)
    _renderers: dict[str, CameraRenderer] = field(default_factory=dict, init=False, repr=False, compare=False)

    def render(self, camera_id: str, t_s: float) -> Image:
        """A camera's image at an instant: uint8 RGB (height, width, 3), exact and free of noise."""
        return self.renderer(camera_id).image(t_s)

    def renderer(self, camera_id: str) -> CameraRenderer:
        """The camera's renderer, made on first use (which takes tenths of a second) and kept. Raises
        ScenarioError for an unknown camera."""
        if camera_id not in self._renderers:
            if camera_id not in self.cameras:
                known = ", ".join(self.cameras)
                raise ScenarioError(f"scene {self.name}: no camera {camera_id!r}; it has {known}")
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


def make_scene(name: str, params: Mapping[str, Any] | None = None) -> Scene:
    """Make the scene ``name``, one of SCENES. params: override its defaults.

    Raises ScenarioError, listing what is valid, for an unknown scene or parameter or a value out of range.
    """
    if name not in SCENES:
        raise ScenarioError(f"unknown scene {name!r}; valid scenes: {', '.join(SCENES)}")
    module = importlib.import_module(f"camera_node.synthetic.scenes.{name}")
    scene: Scene = module.build(read_settings(module.Params, dict(params or {}), f"scene {name}"))
    if getattr(scene.params, "motion_seed", None) is None:
        return scene
    still = {k: v for k, v in as_mapping(scene.params).items() if k not in _MOTION_PARAMETERS}
    return dataclasses.replace(scene, static_key=repr((name, still)))


def pinhole(params: BaseParams) -> Pinhole:
    """The lens that ``params`` describe."""
    return Pinhole.from_fov(params.width, params.height, params.horizontal_fov_deg)
