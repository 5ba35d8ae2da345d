"""Renders the detector's images once and keeps them in files, so that an interrupted run can resume."""

from __future__ import annotations

import os
import zipfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.scene import make_scene
from edge_server.experiments.common.progress import Progress
from edge_server.experiments.training.detector import object_scenes
from edge_server.experiments.training.detector.scenes import KINDS, Boxes, own_rig, scene_of, variation
from freshfield.machine_load import usable_cores

SHARD_SHOTS = 20
INSTANTS = 8
# Test cameras and instants of the shipped scenes, which are never trained on.
RIG_CAMERAS = tuple(f"cam{k:02d}" for k in range(0, 19, 3))
RIG_INSTANTS_S = (0.0, 0.7, 1.6, 2.5)


# Subject of a training -> the kinds of objects that its detector finds.
SUBJECTS = {"scenes": KINDS, "tile": object_scenes.KINDS}


@dataclass(frozen=True)
class LabeledImages:
    """A labeled data set.

    images: uint8 (n, side, side, 3).
    boxes: for each image (m, 5), see scenes.Boxes.
    masks: bool (n, side, side), of the single object that a detector with masks finds; else None.
    """

    images: NDArray[np.uint8]
    boxes: list[Boxes]
    masks: NDArray[np.bool_] | None = None

    def __len__(self) -> int:
        return len(self.images)


def network_inputs(images: NDArray[np.uint8], batch: int) -> Iterator[NDArray[np.float32]]:
    """Yield images (n, H, W, 3) as batches (batch, 3, H, W) in [0, 1]."""
    for first in range(0, len(images), batch):
        part = images[first : first + batch].transpose(0, 3, 1, 2).astype(np.float32)
        yield np.ascontiguousarray(part) / np.float32(255.0)


def render(purpose: str, shots: int, side: int, seed: int, folder: Path, subject: str = "scenes") -> LabeledImages:
    """Render ``INSTANTS`` images of each of ``shots`` variations of a subject (``SUBJECTS``); those already
    in ``folder`` are read from there."""
    folder.mkdir(parents=True, exist_ok=True)
    jobs = []
    for first in range(0, shots, SHARD_SHOTS):
        name = purpose if subject == "scenes" else f"{subject}-{purpose}"
        path = folder / f"{name}-{side}-{seed}-{first:04d}.npz"
        jobs.append((subject, purpose, seed, first, min(SHARD_SHOTS, shots - first), side, path))
    missing = [job for job in jobs if _load(job[-1]) is None]
    if missing:
        progress = Progress(len(missing))
        # Spawned, because torch's threads do not survive a fork.
        with ProcessPoolExecutor(usable_cores(), get_context("spawn")) as pool:
            for job, _ in zip(missing, pool.map(_render_shard, missing)):
                progress.advance(1)
                progress.report(f"{purpose} pictures", f"{job[3] + job[4]} of {shots} worlds", "rendered")
    found = [_load(job[-1]) for job in jobs]
    return joined([part for part in found if part is not None])


def scenes_of(purpose: str, shots: int, seed: int) -> list[str]:
    """The shipped scene that each image of ``render`` is a variation of."""
    return [scene_of(_seed(seed, k), purpose) for k in range(shots) for _ in range(INSTANTS)]


def of_own_rigs(side: int, subject: str = "scenes") -> dict[str, LabeledImages]:
    """Images of the shipped scenes by some of their own cameras; for a single object, as in its scenarios."""
    if subject != "scenes":
        shots = object_scenes.own_shots(side)
        return {name: LabeledImages(*shot.take()) for name, shot in shots.items()}
    return {
        name: joined([LabeledImages(*own_rig(name, c, side).take(instants)) for c in RIG_CAMERAS])
        for name in ("room", "tower", "tile")
        for instants in [RIG_INSTANTS_S if make_scene(name, {"count": 1}).moving else RIG_INSTANTS_S[:1]]
    }


def joined(parts: list[LabeledImages]) -> LabeledImages:
    """Join several sets."""
    masks = [p.masks for p in parts if p.masks is not None]
    return LabeledImages(
        np.concatenate([p.images for p in parts]),
        [b for p in parts for b in p.boxes],
        np.concatenate(masks) if masks else None,
    )


def _render_shard(job: tuple[str, str, int, int, int, int, Path]) -> None:
    subject, purpose, seed, first, shots, side, path = job
    parts = []
    for k in range(first, first + shots):
        if subject == "scenes":
            shot, rng = variation(_seed(seed, k), purpose, side)
            parts.append(LabeledImages(*shot.take(list(rng.uniform(0.0, 12.0, INSTANTS)))))
        else:
            parts.append(LabeledImages(*object_scenes.variation(_seed(seed, k), purpose, side).take()))
    whole = joined(parts)
    counts = [len(b) for b in whole.boxes]
    masks: dict[str, Any] = {} if whole.masks is None else {"masks": whole.masks}
    part = path.with_suffix(f".{os.getpid()}.part")
    with part.open("wb") as file:
        np.savez(file, images=whole.images, counts=counts, boxes=np.concatenate(whole.boxes), **masks)
    part.replace(path)  # atomic: Ctrl-C leaves no partial shard


def _seed(seed: int, number: int) -> int:
    """Seed of the variation with this number."""
    return seed * 1_000_003 + number


def _load(path: Path) -> LabeledImages | None:
    try:
        with np.load(path, allow_pickle=False) as archive:
            ends = np.cumsum(archive["counts"])[:-1]
            boxes = list(np.split(archive["boxes"], ends))
            return LabeledImages(archive["images"], boxes, archive.get("masks"))
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None
