"""Effects: what a scene calls for beyond itself, one file and one class each, imported only when listed.

There are four kinds, by where they act:

* ``world``    adds bodies to the scene (rendered ahead and cached; nothing while streaming);
* ``exposure`` changes how an instant becomes an image (rendered ahead and cached likewise);
* ``image``    changes each frame as it is streamed (the only kind that costs time a frame);
* ``clock``    changes the node's clock, hence its time stamps.

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

from freshfield.scenario import ScenarioError, read_section

if TYPE_CHECKING:
    from camera_node.world.render import Image
    from camera_node.world.scene import Scene

_CLASSES = {
    "clock_drift": "ClockDrift",
    "motion_blur": "MotionBlur",
    "occluder": "Occluder",
    "sensor_noise": "SensorNoise",
}
NAMES = tuple(_CLASSES)


class EffectError(ScenarioError):
    """An effect that cannot be had as listed; the message says what is valid."""


class WorldEffect(Protocol):
    kind: ClassVar[str]

    def extend(self, scene: Scene) -> Scene:
        """The scene with something added to it."""
        ...


class ExposureEffect(Protocol):
    kind: ClassVar[str]

    def expose(self, render: Callable[[float], Image], t_s: float) -> Image:
        """The image of an exposure around an instant, from a function that renders any instant."""
        ...


class ImageEffect(Protocol):
    kind: ClassVar[str]

    def apply(self, image: Image, index: int) -> Image:
        """Frame number ``index`` as the camera delivers it; must not change ``image``."""
        ...


class ClockEffect(Protocol):
    kind: ClassVar[str]

    def node_ns(self, true_ns: int) -> int:
        """What the node's clock shows at a true time."""
        ...


@dataclass(frozen=True)
class Effects:
    """The effects of one camera, by kind and in the order listed, and how they were listed."""

    world: tuple[WorldEffect, ...] = ()
    exposure: tuple[ExposureEffect, ...] = ()
    image: tuple[ImageEffect, ...] = ()
    clock: tuple[ClockEffect, ...] = ()
    rendered: tuple[tuple[str, Any], ...] = ()  # name and parameters of those that change cached frames

    def extend(self, scene: Scene) -> Scene:
        for effect in self.world:
            scene = effect.extend(scene)
        return scene

    def exposed(self, render: Callable[[float], Image]) -> Callable[[float], Image]:
        """``render`` seen through every exposure effect; ``render`` itself where there is none."""
        for effect in self.exposure:
            render = _through(effect, render)
        return render

    def apply(self, image: Image, index: int) -> Image:
        for effect in self.image:
            image = effect.apply(image, index)
        return image

    def node_ns(self, true_ns: int) -> int:
        for effect in self.clock:
            true_ns = effect.node_ns(true_ns)
        return true_ns


NO_EFFECTS = Effects()


def _through(effect: ExposureEffect, render: Callable[[float], Image]) -> Callable[[float], Image]:
    return lambda t_s: effect.expose(render, t_s)


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
