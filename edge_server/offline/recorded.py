"""A recorded data set as the views of one instant, split into those trained on and those held out."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from camera_node.sources import transforms_file, video_files
from camera_node.sources.records import Dataset, DatasetError
from edge_server.fields import View

# What nerfstudio and NeRF-synthetic call the file that a training run starts from.
_PREFERRED = ("transforms.json", "transforms_train.json")


@dataclass(frozen=True)
class Recorded:
    """Views of one instant. file: what was read. instant: which one, for people; empty where nothing moves.
    missing: entries of the file whose images do not exist."""

    file: Path
    training: tuple[View, ...]
    held_out: tuple[View, ...]
    instant: str = ""
    missing: int = 0


def load_recorded(path: Path, holdout: str = "8", scale: float = 1.0, frame: int = 0) -> Recorded:
    """The views of a data set, images decoded, alpha kept.

    path: a transforms JSON, a calibration JSON beside its videos, or a folder with either. holdout: ``8``
    holds out every 8th view (the first, the ninth, ...), ``0`` none, else names of images or cameras with
    commas between. scale: images are divided by it. frame: which instant of a set that moves, from 0.

    Raises camera_node's DatasetError.
    """
    file, dataset = open_dataset(path, scale)
    views, instant = _views(dataset, frame)
    training, held_out = split(views, holdout)
    return Recorded(file, training, held_out, instant, dataset.missing)


def open_dataset(path: Path, scale: float) -> tuple[Path, Dataset]:
    """The file that describes a data set, and its records. Of several in a folder, the first whose images
    exist. Raises DatasetError."""
    if path.is_file():
        return path, _load(path, scale)
    if not path.is_dir():
        raise DatasetError(f"{path}: no such file or folder")
    tried: list[str] = []
    for file in _candidates(path):
        try:
            return file, _load(file, scale)
        except DatasetError as error:
            tried.append(str(error))
    raise DatasetError(
        tried[0]
        if tried
        else f"{path}: expected transforms.json, transforms_*.json or the calibration JSON of videos in it"
    )


def split(views: Sequence[View], holdout: str) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """(training, held out) by ``holdout`` as in ``load_recorded``. Raises DatasetError."""
    every = _whole_number(holdout)
    if every is None:
        wanted = [name.strip() for name in holdout.split(",") if name.strip()]
        for name in wanted:
            if not any(_is_called(view, name) for view in views):
                some = ", ".join(v.camera for v in views[:6])
                raise DatasetError(f"--holdout: no image or camera {name!r} among {len(views)}: {some}, ...")
        out = [any(_is_called(view, name) for name in wanted) for view in views]
    else:
        out = [every > 0 and i % every == 0 for i in range(len(views))]
    training = tuple(v for v, is_out in zip(views, out) if not is_out)
    if not training:
        raise DatasetError(
            f"--holdout {holdout}: all {len(views)} views are held out, none is left to train on"
        )
    return training, tuple(v for v, is_out in zip(views, out) if is_out)


def _whole_number(text: str) -> int | None:
    return int(text) if text.strip().isdigit() else None


def _is_called(view: View, name: str) -> bool:
    path = Path(view.camera)
    return name in (view.camera, path.name, path.stem)


def _candidates(folder: Path) -> list[Path]:
    named = [folder / name for name in _PREFERRED if (folder / name).is_file()]
    patterns = ("transforms*.json", "calib*.json")
    return list(dict.fromkeys([*named, *(f for p in patterns for f in sorted(folder.glob(p)))]))


def _load(file: Path, scale: float) -> Dataset:
    try:
        described = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{file}: cannot be read as JSON: {error}") from None
    if isinstance(described, dict) and "frames" not in described:
        return video_files.load_dataset(file, scale)
    return transforms_file.load_dataset(file, scale, "keep")


def _views(dataset: Dataset, frame: int) -> tuple[list[View], str]:
    """One view a camera of a set that moves, else one a record; and which instant."""
    if dataset.moving:
        cameras = {camera: dataset.of(camera) for camera in dataset.cameras}
        count = min(len(records) for records in cameras.values())
        if not 0 <= frame < count:
            raise DatasetError(f"--frame {frame}: the recording has the frames 0 to {count - 1}")
        found = {camera: records[frame] for camera, records in cameras.items()}
        instant = f"frame {frame} of {count}"
    else:
        # Photos of one camera are told apart by their names, a still rig by its cameras.
        rig = len(dataset.cameras) == len(dataset)
        found = {(r.camera if rig else r.name): r for r in dataset}
        instant = ""
    return [View(n, r.read(), r.camera_to_world, r.intrinsics) for n, r in found.items()], instant
