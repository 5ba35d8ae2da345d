"""Formats of data sets, one reader module each, and which of them a folder or file is of.

The formats are the kinds of ``camera_node.config`` whose keys are a ``RecordedConfig``: a new one is a reader
module here, called as the kind, and its keys there.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol, cast

from camera_node.config import MODELS, RecordedConfig
from camera_node.sources.datasets.photo import ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, find_files
from camera_node.sources.datasets.video import VideoRig

# In this order: where several fit, the one that says most about its images comes first.
FORMATS = tuple(kind for kind, model in MODELS.items() if issubclass(model, RecordedConfig))


class Reader(Protocol):
    """What the module of a format offers. FILES: patterns of the files that describe a data set in a folder;
    the first usable one is taken."""

    FILES: tuple[str, ...]

    def describes(self, file: Path) -> bool:
        """Whether a file describes a data set of this format. Raises DatasetError for a damaged one."""

    def load_dataset(self, path: Path, options: ImageOptions) -> Dataset:
        """The posed images of a folder or describing file. Raises DatasetError."""

    def from_config(self, path: Path, config: Any) -> Dataset | VideoRig:
        """What a scenario's section, whose ``data`` is at ``path``, asks for. Raises DatasetError."""


def reader(name: str) -> Reader:
    """The reader of one of ``FORMATS``; only its module is imported."""
    return cast(Reader, importlib.import_module(f"camera_node.sources.datasets.{name}"))


def open_dataset(path: Path, scale: float = 1.0, name: str | None = None) -> tuple[Path, Dataset]:
    """The describing file of a data set, and its images with alpha kept. Raises DatasetError.

    path: the describing file, or a folder, of whose describing files the first whose images exist is taken.
    scale: images are divided by it.
    name: of the format, instead of recognizing it.
    """
    if name is not None and name not in FORMATS:
        raise DatasetError(f"format {name!r}: expected one of {', '.join(FORMATS)}")
    options = ImageOptions(scale)
    if path.is_file():
        # What no other format claims is taken for a transforms JSON, whose reader says what is missing.
        found = (key for key in FORMATS if reader(key).describes(path))
        return path, reader(name or next(found, "transforms")).load_dataset(path, options)
    if not path.is_dir():
        raise DatasetError(f"{path}: no such file or folder")
    errors: list[str] = []
    for key in FORMATS if name is None else (name,):
        for file in find_files(path, reader(key).FILES):
            try:
                return file, reader(key).load_dataset(file, options)
            except DatasetError as error:
                errors.append(str(error))
    if errors:
        raise DatasetError(errors[0])
    if name is not None:
        raise DatasetError(f"{path}: holds no data set of the format {name}")
    raise DatasetError(
        f"{path}: holds no data set: expected transforms.json, transforms_*.json, the calibration JSON of "
        "videos, poses_bounds.npy, annots.npy, Eyeful's cameras.json or a COLMAP model"
    )
