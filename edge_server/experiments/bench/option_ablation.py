"""The optional parts of the representations, and scenes with and without a need for them.

``bench options`` measures all ``OPTIONS``; to add an option, add a line there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.bench.run import RECORDINGS, data_file, open_recording
from edge_server.experiments.scenes.multiview_sequence import MultiviewSequence, recorded_sequence, synthetic_sequence
from edge_server.experiments.scenes.multiview_still import MultiviewStill, synthetic_still
from edge_server.fields import View
from freshfield.geometry import so3_exp

VIEWS, SIZE = 18, 128
FEW = 6  # number of training views, evenly spread, of scenes with few views
GAIN_SPREAD = 0.2  # standard deviation of the logarithm of a camera's gain in each channel
POSE_M, POSE_DEG = 0.01, 1.0
LATE_FRAMES = 4  # frames of 1/15 s: views are up to 267 ms old


@dataclass(frozen=True)
class Option:
    """One optional part of a representation. off, on: options of a field. scenes: keys of ``SCENES``."""

    name: str
    off: Mapping[str, Any]
    on: Mapping[str, Any]
    scenes: tuple[str, ...]


OPTIONS: tuple[Option, ...] = (
    Option("view-dependent color", {"harmonics": 1}, {"harmonics": 4}, ("tile", "room", "lego", "kitchen")),
    Option("exposure", {"exposure": False}, {"exposure": True}, ("room, gains", "room")),
    Option("contraction", {"contracted": False}, {"contracted": True}, ("room", "tile")),
    Option(
        "pose refinement",
        {"refine_m": 0.0, "refine_deg": 0.0},
        {"refine_m": 0.03, "refine_deg": 3.0},
        ("room, poses", "room"),
    ),
    Option("random background", {"background": "auto"}, {"background": "random"}, ("tile", "lego")),
    Option("distortion loss", {"distortion": 0.0}, {"distortion": 0.01}, ("tile", "room")),
    Option("no density seen by few", {"min_views": 0}, {"min_views": 2}, ("tile", "room")),
    Option(
        "changed pixels first", {"changed_share": 0.0}, {"changed_share": 0.25}, ("room, moving", "kitchen, moving")
    ),
    Option(
        "depth guide", {"depth_guide": 0.0}, {"depth_guide": 0.1}, ("tile", "tile, six", "lego", "kitchen, six", "room")
    ),
    Option("smoothness", {"smooth": 0.0}, {"smooth": 3e-3}, ("tile", "room")),
    Option("diffusion", {"diffuse": 0.0}, {"diffuse": 1.0}, ("tile", "room", "kitchen", "lego")),
    Option("appearance", {"appearance": 0}, {"appearance": 8}, ("room, gains", "room")),
    Option("outlines", {"outline": 0.0}, {"outline": 0.25}, ("tile", "room")),
    Option("weighed by age", {"age_tau_ms": 0.0}, {"age_tau_ms": 100.0}, ("room, late", "room, moving")),
    Option("stale pixels masked", {"mask_stale_ms": 0.0}, {"mask_stale_ms": 50.0}, ("room, late", "room, moving")),
    Option("movement followed", {"follow": 0}, {"follow": 8}, ("room, late", "room, moving")),
    Option("wrong views refused", {"refuse_beyond": 0.0}, {"refuse_beyond": 2.5}, ("room, moving", "kitchen, moving")),
)


@dataclass(frozen=True)
class Scene:
    """The views that a field is fitted to and scored on: a still, from scratch, or a sequence, in updates.
    Scores of a sequence are means over the updates.

    late: largest age of the views of a sequence, in frames.
    """

    still: MultiviewStill | None = None
    sequence: MultiviewSequence | None = None
    late: int = 0


def _synthetic(name: str) -> Scene:
    return Scene(synthetic_still(name, cameras=VIEWS + 1, size=SIZE))


def _recorded(name: str, scale: float) -> Scene:
    return Scene(open_recording(name, scale))


def _few(make: Callable[[], Scene]) -> Scene:
    """Some of a still scene's views, evenly spread."""
    scene = make()
    assert scene.still is not None
    training = scene.still.training
    some = [training[k] for k in np.linspace(0, len(training) - 1, FEW).round().astype(int)]
    return replace(scene, still=replace(scene.still, training=tuple(some)))


def _gains() -> Scene:
    still = synthetic_still("room", cameras=VIEWS + 1, size=SIZE)
    return Scene(replace(still, name="room, gains", training=with_gains(still.training, GAIN_SPREAD)))


def _poses() -> Scene:
    still = synthetic_still("room", cameras=VIEWS + 1, size=SIZE)
    return Scene(replace(still, name="room, poses", training=displaced(still.training, POSE_M, POSE_DEG)))


def _moving(late: int = 0) -> Scene:
    return Scene(sequence=synthetic_sequence("room", VIEWS + 1, SIZE, 15.0, speed_m_per_s=1.0), late=late)


def _kitchen_moving() -> Scene:
    return Scene(sequence=recorded_sequence(data_file(RECORDINGS["kitchen"][0]), "cam00"))


SCENES: dict[str, tuple[str, Callable[[], Scene]]] = {
    "tile": ("18 views", partial(_synthetic, "tile")),
    "room": ("18 views", partial(_synthetic, "room")),
    "room, gains": (f"each camera and channel with a gain of its own, e^N(0, {GAIN_SPREAD:g})", _gains),
    "room, poses": (f"each camera off by {100 * POSE_M:g} cm and {POSE_DEG:g} degree", _poses),
    "room, moving": ("a person at 1 m/s, 15 frames a second", _moving),
    "room, late": ("the same, views 0 to 267 ms old", partial(_moving, LATE_FRAMES)),
    "lego": ("at 200 x 200, every 8th held out", partial(_recorded, "lego", 2.0)),
    "kitchen": ("the first instant", partial(_recorded, "kitchen", 1.0)),
    "tile, six": (f"{FEW} of them", partial(_few, partial(_synthetic, "tile"))),
    "kitchen, six": (f"{FEW} of its 18 views", partial(_few, partial(_recorded, "kitchen", 1.0))),
    "kitchen, moving": ("30 frames a second", _kitchen_moving),
}
MOVING = ("room, moving", "room, late", "kitchen, moving")


def with_gains(views: Sequence[View], spread: float, seed: int = 3) -> tuple[View, ...]:
    """Multiply each view with random gains, one per channel, log-normal with a geometric mean of 1."""
    gains = np.exp(np.random.default_rng(seed).normal(0.0, spread, (len(views), 3)))
    gains /= np.exp(np.log(gains).mean(axis=0))
    images = [np.clip(v.image[..., :3] * g + 0.5, 0.0, 255.0).astype(np.uint8) for v, g in zip(views, gains)]
    return tuple(replace(v, image=image) for v, image in zip(views, images))


def displaced(views: Sequence[View], size_m: float, deg: float, seed: int = 5) -> tuple[View, ...]:
    """Displace the pose of each view by ``size_m`` and ``deg`` on average, in random directions. The errors
    have a mean of zero, because a common error could not be distinguished from a displaced scene."""
    both = np.random.default_rng(seed).normal(size=(2, len(views), 3))
    both -= both.mean(axis=1, keepdims=True)
    turns, shifts = both / np.linalg.norm(both, axis=2).mean(axis=1)[:, None, None]
    out = []
    for view, turn, shift in zip(views, turns * np.deg2rad(deg), shifts * size_m):
        pose = np.array(view.camera_to_world)
        pose[:3, :3] = so3_exp(turn) @ pose[:3, :3]
        pose[:3, 3] += shift
        out.append(replace(view, camera_to_world=pose))
    return tuple(out)


def missing(scenes: Iterable[str]) -> set[str]:
    """The scenes whose recordings are not available; prints the reasons."""
    out = set()
    for scene in sorted(scenes):
        recording = scene.split(",")[0]
        if recording in RECORDINGS:
            try:
                folder = data_file(RECORDINGS[recording][0].split("/")[0])
                if not folder.is_dir():
                    raise DatasetError(f"{folder.parent} has no folder {folder.name}")
            except DatasetError as error:
                print(f"  {scene} left out: {error}", flush=True)
                out.add(scene)
    return out
