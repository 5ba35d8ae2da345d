"""Which data set lies in a folder, and its images, whatever the format: for what reads data sets offline."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from camera_node.sources.datasets import colmap, dynerf, eyeful, transforms, video, zju
from camera_node.sources.datasets.photo import Look
from camera_node.sources.datasets.records import Dataset, DatasetError

# What nerfstudio and NeRF-synthetic call the file that a training run starts from.
_PREFERRED = ("transforms.json", "transforms_train.json")


def _transforms(folder: Path) -> list[Path]:
    named = [folder / name for name in _PREFERRED if (folder / name).is_file()]
    return list(dict.fromkeys([*named, *sorted(folder.glob("transforms*.json"))]))


def _eyeful(folder: Path) -> list[Path]:
    return [folder / name for name in ("cameras.json", "cameras.xml") if (folder / name).is_file()]


def _colmap(folder: Path) -> list[Path]:
    found = colmap.find_model(folder)
    return [] if found is None else [found]


def _called(*patterns: str) -> Callable[[Path], list[Path]]:
    return lambda folder: [file for pattern in patterns for file in sorted(folder.glob(pattern))]


# Name -> (the files that a folder of the format has, of which the first usable one is taken; the loader). In
# this order: where several fit, the one that says most about its images comes first.
FORMATS: dict[str, tuple[Callable[[Path], list[Path]], Callable[[Path, float], Dataset]]] = {
    "transforms": (_transforms, lambda file, scale: transforms.load_dataset(file, scale, "keep")),
    "video": (_called("calib*.json"), lambda file, scale: video.load_dataset(file, scale)),
    "dynerf": (_called(dynerf.POSES), lambda file, scale: dynerf.load_dataset(file, scale)),
    "zju": (_called(zju.ANNOTATIONS), lambda file, scale: zju.load_dataset(file, Look(scale))),
    "eyeful": (_eyeful, lambda file, scale: eyeful.load_dataset(file, Look(scale))),
    "colmap": (_colmap, lambda file, scale: colmap.load_dataset(file, Look(scale))),
}


def open_dataset(path: Path, scale: float = 1.0, name: str | None = None) -> tuple[Path, Dataset]:
    """The file that describes a data set, and its records with alpha kept. Of several in a folder, the first
    whose images exist.

    path: a folder, or the describing file itself. name: of the format, instead of recognising it. Raises
    DatasetError.
    """
    if name is not None and name not in FORMATS:
        raise DatasetError(f"format {name!r}: expected one of {', '.join(FORMATS)}")
    if path.is_file():
        return path, FORMATS[name or _of_file(path)][1](path, scale)
    if not path.is_dir():
        raise DatasetError(f"{path}: no such file or folder")
    tried: list[str] = []
    for key in FORMATS if name is None else (name,):
        find, load = FORMATS[key]
        for file in find(path):
            try:
                return file, load(file, scale)
            except DatasetError as error:
                tried.append(str(error))
    if tried:
        raise DatasetError(tried[0])
    if name is not None:
        raise DatasetError(f"{path}: holds no data set of the format {name}")
    raise DatasetError(
        f"{path}: holds no data set: expected transforms.json, transforms_*.json, the calibration JSON of "
        f"videos, {dynerf.POSES}, {zju.ANNOTATIONS}, Eyeful's cameras.json or a COLMAP model"
    )


def _of_file(file: Path) -> str:
    """The format of a describing file, by its name or what it holds. Raises DatasetError."""
    if file.name == dynerf.POSES:
        return "dynerf"
    if file.name == zju.ANNOTATIONS:
        return "zju"
    if file.suffix == ".xml":
        return "eyeful"
    if file.suffix in (".bin", ".txt"):
        return "colmap"
    try:
        described = json.loads(file.read_text())
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise DatasetError(f"{file}: cannot be read as JSON: {error}") from None
    if isinstance(described, dict) and "KRT" in described:
        return "eyeful"
    return "video" if isinstance(described, dict) and "frames" not in described else "transforms"
