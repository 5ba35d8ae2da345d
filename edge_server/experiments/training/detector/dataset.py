"""Renders the detector's images once and keeps them in files, so that an interrupted run can resume."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.scene import make_scene
from edge_server.experiments.engine import Engine
from edge_server.experiments.training.detector.scenes import Boxes, own_rig, variation
from freshfield.machine_load import usable_cores

SHARD_SHOTS = 20
INSTANTS = 8
# Test cameras and instants of the shipped scenes, which are never trained on.
RIG_CAMERAS = tuple(f"cam{k:02d}" for k in range(0, 19, 3))
RIG_INSTANTS_S = (0.0, 0.7, 1.6, 2.5)


@dataclass(frozen=True)
class LabeledImages:
    """A labeled data set.

    images: uint8 (n, side, side, 3).
    boxes: for each image (m, 5), see scenes.Boxes.
    """

    images: NDArray[np.uint8]
    boxes: list[Boxes]

    def __len__(self) -> int:
        return len(self.images)


@dataclass(frozen=True)
class Shard:
    """A file of images: ``shots`` variations from number ``first`` on, each of ``INSTANTS`` images."""

    purpose: str
    seed: int
    first: int
    shots: int
    side: int
    path: Path


def network_inputs(images: NDArray[np.uint8], batch: int) -> Iterator[NDArray[np.float32]]:
    """Yield images (n, H, W, 3) as batches (batch, 3, H, W) in [0, 1]."""
    for first in range(0, len(images), batch):
        part = images[first : first + batch].transpose(0, 3, 1, 2).astype(np.float32)
        yield np.ascontiguousarray(part) / np.float32(255.0)


def render(purpose: str, shots: int, side: int, seed: int, folder: Path) -> LabeledImages:
    """Render ``INSTANTS`` images of each of ``shots`` variations; those already in ``folder`` are read from there."""
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{purpose}-{side}-{seed}"
    shards = [
        Shard(purpose, seed, first, min(SHARD_SHOTS, shots - first), side, folder / f"{name}-{first:04d}.npz")
        for first in range(0, shots, SHARD_SHOTS)
    ]
    missing = [shard for shard in shards if _load(shard.path) is None]
    Engine(jobs=usable_cores()).run(render_shard, missing, f"{purpose} pictures")
    found = [_load(shard.path) for shard in shards]
    return joined([part for part in found if part is not None])


def of_own_rigs(side: int) -> dict[str, LabeledImages]:
    """Images of the shipped scenes by some of their own cameras."""
    return {
        name: joined([LabeledImages(*own_rig(name, c, side).take(instants)) for c in RIG_CAMERAS])
        for name in ("room", "tower", "tile")
        for instants in [RIG_INSTANTS_S if make_scene(name, {"count": 1}).moving else RIG_INSTANTS_S[:1]]
    }


def joined(parts: list[LabeledImages]) -> LabeledImages:
    """Join several sets."""
    return LabeledImages(np.concatenate([p.images for p in parts]), [b for p in parts for b in p.boxes])


def render_shard(shard: Shard) -> None:
    """Render the images of one file."""
    parts = []
    for k in range(shard.first, shard.first + shard.shots):
        shot, rng = variation(shard.seed * 1_000_003 + k, shard.purpose, shard.side)
        parts.append(LabeledImages(*shot.take(list(rng.uniform(0.0, 12.0, INSTANTS)))))
    whole = joined(parts)
    counts = [len(b) for b in whole.boxes]
    part = shard.path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        np.savez(file, images=whole.images, counts=counts, boxes=np.concatenate(whole.boxes))
    part.replace(shard.path)  # atomic: Ctrl-C leaves no partial shard


def _load(path: Path) -> LabeledImages | None:
    try:
        with np.load(path, allow_pickle=False) as archive:
            ends = np.cumsum(archive["counts"])[:-1]
            boxes = list(np.split(archive["boxes"], ends))
            return LabeledImages(archive["images"], boxes)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
