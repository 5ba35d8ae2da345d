"""Effects: what a scene calls for beyond itself, one file and one class each, imported only when listed.

The kinds, by where they act:

* ``world``    changes the scene: bodies, shadows, gloss, fog (rendered ahead and cached; nothing while
  streaming);
* ``lens``     changes the lens that a camera looks through, and what it says of it (likewise);
* ``exposure`` changes how an instant becomes an image (likewise);
* ``image``    changes each frame as it is streamed, recorded ones too (costs time a frame);
* ``clock``    changes the node's clock, hence its time stamps;
* ``pose``     changes where a camera says that it is, not what it sees.

Adding one is a file here with a class (attributes ``kind`` and ``Parameters``, constructor of parameters
and a random stream) and a line in ``_CLASSES``.

The held-out camera is the measuring instrument: it shows the sharp, noise-free, unobstructed scene at
the true time, so effects do not apply to it unless they are listed with ``in_truth: true``.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

import numpy as np

from freshfield.geometry import Pinhole, Pose
from freshfield.scenario import ScenarioError, read_section

if TYPE_CHECKING:
    from camera_node.synthetic.render import Image, Rows
    from camera_node.synthetic.scene import Scene

_CLASSES = {
    "clock_drift": "ClockDrift",
    "exposure_drift": "ExposureDrift",
    "fog": "Fog",
    "hot_pixels": "HotPixels",
    "lens_distortion": "LensDistortion",
    "motion_blur": "MotionBlur",
    "occluder": "Occluder",
    "pose_noise": "PoseNoise",
    "rolling_shutter": "RollingShutter",
    "sensor_noise": "SensorNoise",
    "shadows": "Shadows",
    "specular": "Specular",
    "vignetting": "Vignetting",
}
NAMES = tuple(_CLASSES)


class EffectError(ScenarioError):
    """An effect that cannot be had as listed; the message says what is valid."""


def check_ranges(parameters: object, **ranges: tuple[float, float]) -> None:
    """Raises ValueError, in one line, for an attribute outside (lowest, highest)."""
    for name, (low, high) in ranges.items():
        value = getattr(parameters, name)
        if not low <= value <= high:  # nor is NaN
            raise ValueError(f"{name} must be within {low:g} to {high:g}, got {value}")


class WorldEffect(Protocol):
    kind: ClassVar[str]

    def extend(self, scene: Scene) -> Scene:
        """The scene with something added to it."""
        ...


class LensEffect(Protocol):
    kind: ClassVar[str]

    def through(self, camera: Pinhole) -> Pinhole:
        """The lens that images are taken with, where the scene has ``camera``."""
        ...

    def claimed(self, camera: Pinhole) -> Pinhole:
        """What is sent of the lens ``camera`` that ``through`` gave."""
        ...


class View(Protocol):
    """A camera that shows any instant, or only some rows of it: a CameraRenderer, or one seen through
    effects."""

    @property
    def camera(self) -> Pinhole: ...

    def image(self, t_s: float, rows: Rows | None = None) -> Image: ...


class ExposureEffect(Protocol):
    kind: ClassVar[str]

    def expose(self, view: View, t_s: float, rows: Rows | None = None) -> Image:
        """The image of an exposure around an instant, or some of its rows (first, one after the last)."""
        ...


class ImageEffect(Protocol):
    kind: ClassVar[str]

    def apply(self, image: Image, index: int, t_s: float) -> Image:
        """Frame number ``index``, taken ``t_s`` after the epoch, as the camera delivers it; must not change
        ``image``."""
        ...


class ClockEffect(Protocol):
    kind: ClassVar[str]

    def node_ns(self, true_ns: int) -> int:
        """What the node's clock shows at a true time."""
        ...


class PoseEffect(Protocol):
    kind: ClassVar[str]

    @property
    def varies(self) -> bool:
        """Whether frames of one camera claim different poses."""
        ...

    def claimed(self, pose: Pose, index: int) -> Pose:
        """The pose that frame number ``index`` claims, taken from ``pose``."""
        ...


@dataclass(frozen=True)
class Effects:
    """The effects of one camera, by kind and in the order listed, and how they were listed."""

    world: tuple[WorldEffect, ...] = ()
    lens: tuple[LensEffect, ...] = ()
    exposure: tuple[ExposureEffect, ...] = ()
    image: tuple[ImageEffect, ...] = ()
    clock: tuple[ClockEffect, ...] = ()
    pose: tuple[PoseEffect, ...] = ()
    rendered: tuple[tuple[str, Any], ...] = ()  # name and parameters of those that change cached frames

    def extend(self, scene: Scene) -> Scene:
        """The scene with what effects of the kinds world and lens make of it. Raises EffectError."""
        for effect in self.world:
            scene = effect.extend(scene)
        if self.lens:
            scene = scene.with_cameras({c: (self._through(k), p) for c, (k, p) in scene.cameras.items()})
        return scene

    def _through(self, camera: Pinhole) -> Pinhole:
        for effect in self.lens:
            camera = effect.through(camera)
        return camera

    def claimed_lens(self, camera: Pinhole) -> Pinhole:
        """What is sent of the lens that the extended scene has."""
        for effect in reversed(self.lens):
            camera = effect.claimed(camera)
        return camera

    def exposed(self, view: View) -> View:
        """``view`` seen through every exposure effect; ``view`` itself where there is none."""
        for effect in self.exposure:
            view = _Exposed(effect, view)
        return view

    def apply(self, image: Image, index: int, t_s: float) -> Image:
        for effect in self.image:
            image = effect.apply(image, index, t_s)
        return image

    def node_ns(self, true_ns: int) -> int:
        for effect in self.clock:
            true_ns = effect.node_ns(true_ns)
        return true_ns

    @property
    def pose_varies(self) -> bool:
        return any(effect.varies for effect in self.pose)

    def claimed_pose(self, pose: Pose, index: int) -> Pose:
        for effect in self.pose:
            pose = effect.claimed(pose, index)
        return pose


NO_EFFECTS = Effects()


@dataclass(frozen=True)
class _Exposed:
    effect: ExposureEffect
    view: View

    @property
    def camera(self) -> Pinhole:
        return self.view.camera

    def image(self, t_s: float, rows: Rows | None = None) -> Image:
        return self.effect.expose(self.view, t_s, rows)


def load_effects(
    listed: Mapping[str, Mapping[str, Any] | None],
    rng_for: Callable[[str], np.random.Generator],
    held_out: bool = False,
) -> Effects:
    """The listed effects (name -> parameters) of one camera.

    rng_for: the random stream of an effect and this camera, called once for each effect that is made.
    held_out: this camera shows the truth; only effects with ``in_truth: true`` apply.
    Raises EffectError for an unknown effect or parameter. Nothing listed: nothing is imported or made.
    """
    found: dict[str, list[Any]] = {}
    rendered: list[tuple[str, Any]] = []
    for name, given in listed.items():
        if name not in _CLASSES:
            raise EffectError(f"unknown effect {name!r}; valid effects: {', '.join(NAMES)}")
        cls = getattr(importlib.import_module(f"{__name__}.{name}"), _CLASSES[name])
        try:
            parameters = read_section(cls.Parameters, dict(given or {}), f"effect {name}")
        except ScenarioError as error:
            raise EffectError(str(error)) from None
        if held_out and not parameters.in_truth:
            continue
        found.setdefault(cls.kind, []).append(cls(parameters, rng_for(name)))
        if cls.kind in ("world", "exposure"):
            rendered.append((name, parameters))
    if not found:
        return NO_EFFECTS
    return Effects(rendered=tuple(rendered), **{kind: tuple(made) for kind, made in found.items()})
