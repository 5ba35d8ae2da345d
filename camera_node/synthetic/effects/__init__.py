"""Effects that a scenario may list: one file and one class each, imported only when listed.

The kinds, by where they act:

* ``image``    changes each frame as it is streamed, recorded ones too (costs time a frame);
* ``clock``    changes the node's clock and so its time stamps;
* ``pose``     changes the pose that frames report, not the image;
* ``delay``    changes the instant of that pose, of a camera that moves;
* ``mount``    changes where a camera really stands, not the pose that frames report (rendered as frames are due);
* ``depth``    measures depth with frames that carry it (costs time for each of those).

To add one, write a file here with a dataclass of the same name (the effect's parameters and ``kind``) and add
it to ``NAMES``. An effect that draws from a camera's random stream does so in ``start``.

The held-out camera measures: it shows the sharp, noise-free scene at the true time. Effects apply to its frames only
if they are listed with ``in_truth: true``; a run in virtual time that scores against the world itself has none.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.clocks import ClockError
from camera_node.synthetic.render import Image
from freshfield import plugins
from freshfield.depth import DepthImage
from freshfield.geometry import Array, Pinhole, Pose
from freshfield.settings import ScenarioError, Settings, about, read_settings

NAMES = ("bump", "clock_drift", "depth_sensor", "exposure_drift", "pose_delay", "pose_noise")


class EffectParameters(Settings, frozen=True, kw_only=True):
    """Base of the effects' parameters."""

    in_truth: Annotated[bool, about("whether the effect applies to held-out cameras as well")] = False
    cameras: Annotated[tuple[str, ...], about("the cameras it applies to; not given: all")] = ()

    kind: ClassVar[str]

    def start(self, rng: np.random.Generator) -> Any:
        """The effect on one camera: an object with the protocol of its kind below. rng: the effect's random
        stream for this camera."""
        return self


def effect_class(name: str) -> type[EffectParameters]:
    """Import and return the class of an effect, one of NAMES or from outside (``freshfield.plugins``). Raises
    ScenarioError for an unknown name."""
    if name not in NAMES:
        try:
            found: type[EffectParameters] = plugins.find("effect", name, NAMES)
        except plugins.PluginError as error:
            raise ScenarioError(str(error)) from None
        if not (issubclass(found, EffectParameters) and getattr(found, "kind", None) in Effects.__dataclass_fields__):
            kinds = ", ".join(Effects.__dataclass_fields__)
            raise ScenarioError(f"effect {name}: expected a subclass of EffectParameters whose kind is one of {kinds}")
        return found
    return getattr(importlib.import_module(f"{__name__}.{name}"), name.title().replace("_", ""))


def frame_rng(key: NDArray[np.uint64], index: int) -> np.random.Generator:
    """Random stream of frame number ``index`` under a key (2,), independent of the order of the frames."""
    return np.random.Generator(np.random.Philox(key=key, counter=[0, 0, 0, index]))


class ImageEffect(Protocol):
    def apply(self, image: Image, index: int, t_s: float) -> Image:
        """Frame number ``index``, taken ``t_s`` after the epoch, as the camera delivers it. Must not change
        ``image``."""
        ...


class PoseEffect(Protocol):
    @property
    def varies(self) -> bool:
        """Whether frames of one camera report different poses."""
        ...

    def reported(self, pose: Pose, index: int, t_s: float) -> Pose:
        """The pose that frame number ``index``, taken from ``pose`` at ``t_s`` after the epoch, reports."""
        ...


class DelayEffect(Protocol):
    def instant_s(self, t_s: float) -> float:
        """The instant whose pose a frame taken at ``t_s`` reports."""
        ...


class MountEffect(Protocol):
    def placed(self, camera_to_world: Array, t_s: float) -> Array:
        """Where a camera that was mounted at a pose, (4, 4), really stands at ``t_s`` after the epoch."""
        ...


class DepthEffect(Protocol):
    def measure(self, depth_m: NDArray[np.float32], image: Image, camera: Pinhole, index: int) -> DepthImage:
        """What a sensor measures with frame number ``index``.

        depth_m: exact depth (H, W) along the optical axis, 0 where nothing is. Must not be changed, nor ``image``.
        image: uint8 (H, W, 3), what the camera shows. camera: its lens.
        """
        ...


@dataclass(frozen=True)
class Effects:
    """The effects of one camera, by kind and in the order listed."""

    image: tuple[ImageEffect, ...] = ()
    clock: tuple[ClockError, ...] = ()
    pose: tuple[PoseEffect, ...] = ()
    delay: tuple[DelayEffect, ...] = ()
    mount: tuple[MountEffect, ...] = ()
    depth: tuple[DepthEffect, ...] = ()

    def apply(self, image: Image, index: int, t_s: float) -> Image:
        """``image`` with every image effect; see ``ImageEffect``."""
        for effect in self.image:
            image = effect.apply(image, index, t_s)
        return image

    def node_ns(self, true_ns: int) -> int:
        """Time of the node's clock, with every clock effect, at a true time."""
        for effect in self.clock:
            true_ns = effect.node_ns(true_ns)
        return true_ns

    @property
    def pose_varies(self) -> bool:
        """Whether the reported poses differ from frame to frame."""
        return any(effect.varies for effect in self.pose)

    def reported_pose(self, pose: Pose, index: int, t_s: float) -> Pose:
        """The pose that frame number ``index``, taken from ``pose`` at ``t_s``, reports."""
        for effect in self.pose:
            pose = effect.reported(pose, index, t_s)
        return pose

    def pose_instant_s(self, t_s: float) -> float:
        """The instant whose pose a frame taken at ``t_s`` reports."""
        for effect in self.delay:
            t_s = effect.instant_s(t_s)
        return t_s

    def placed(self, camera_to_world: Array, t_s: float) -> Array:
        """Where the camera really stands, see ``MountEffect``."""
        for effect in self.mount:
            camera_to_world = effect.placed(camera_to_world, t_s)
        return camera_to_world


NO_EFFECTS = Effects()


def load_effects(
    listed: Mapping[str, Mapping[str, Any] | None],
    rng_for: Callable[[str], np.random.Generator],
    held_out: bool = False,
    camera: str = "",
) -> Effects:
    """The listed effects (name -> parameters) of one camera; NO_EFFECTS if none applies.

    camera: its name, for effects that list ``cameras``.
    rng_for: gives the random stream of an effect for this camera; called once for each effect that applies.
    held_out: only effects with ``in_truth: true`` apply.
    Raises ScenarioError for an unknown effect or parameter.
    """
    found: dict[str, list[Any]] = {}
    for name, given in listed.items():
        effect = read_settings(effect_class(name), dict(given or {}), f"effect {name}")
        if (held_out and not effect.in_truth) or (effect.cameras and camera not in effect.cameras):
            continue
        found.setdefault(effect.kind, []).append(effect.start(rng_for(name)))
    if not found:
        return NO_EFFECTS
    return Effects(**{kind: tuple(made) for kind, made in found.items()})
