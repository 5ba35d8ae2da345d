"""The data set formats, and how to recognize the format of a folder or file.

Formats are the kinds of ``camera_node.settings`` whose dataclass is a ``RecordedConfig``. To add one, add a
reader module here, named like the kind, and a dataclass there, whose fields are the reader's arguments.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any, Protocol, cast

from camera_node.settings import MODELS, RecordedConfig, VideoConfig
from camera_node.sources.datasets import rgbd
from camera_node.sources.datasets.photo import ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, find_files, read_json

# In this order of preference: if several fit, the one with most information about its images comes first.
FORMATS = tuple(kind for kind, model in MODELS.items() if issubclass(model, RecordedConfig))


_RECORDINGS = (".mcap", ".db3", ".bag")
_VIDEOS = (".mp4", ".mov", ".mkv", ".avi", ".webm")
_OF_VIDEO = "a video and its trajectory are named in a scenario: freshfield scenario init mine.yaml --like video"


class Reader(Protocol):
    """Interface of a format's module. FILES: patterns of the files that describe a data set in a folder; the
    first usable one is taken."""

    FILES: tuple[str, ...]

    def load_dataset(self, path: Path, options: ImageOptions, **keys: Any) -> Dataset:
        """The posed images of a folder or describing file. Raises DatasetError."""


def reader(name: str) -> Reader:
    """Import and return the reader module of a format, one of ``FORMATS``."""
    room = "rgbd." if name in rgbd.FORMATS else ""
    return cast(Reader, importlib.import_module(f"camera_node.sources.datasets.{room}{name}"))


def open_configured(path: Path, config: RecordedConfig) -> Dataset:
    """Open the data set of a scenario's ``source:`` section. path: located ``data``. Raises DatasetError."""
    shared = {*RecordedConfig.__struct_fields__, "background", "trajectory"}
    keys = {name: getattr(config, name) for name in config.__struct_fields__ if name not in shared}
    if isinstance(config, VideoConfig):
        keys["require_poses"] = False  # a trajectory may give them
    options = ImageOptions(config.scale, getattr(config, "background", "keep"))
    return reader(config.kind).load_dataset(path, options, **keys)


def recognize(file: Path) -> str:
    """The format of a describing file, by its name or the contents of its JSON.

    Returns ``transforms`` if nothing matches; its reader then reports what is missing. Raises DatasetError
    for a damaged JSON file.
    """
    if file.name == "metadata.json":
        return "record3d"
    if file.suffix in _RECORDINGS:
        return "foxglove" if file.suffix == ".mcap" else "rosbag"
    if file.suffix in (".bin", ".txt"):
        return {"rgb.txt": "tum", "frame-000000.pose.txt": "sevenscenes"}.get(file.name, "colmap")
    if file.suffix.lower() in _VIDEOS:
        raise DatasetError(f"{file}: its lens and poses are not known: {_OF_VIDEO}")
    data = read_json(file) if file.suffix == ".json" else None
    if isinstance(data, dict):
        return "transforms" if "frames" in data else "eyeful" if "KRT" in data else "video"
    return next((name for name in FORMATS if file.name in reader(name).FILES), "transforms")


def _candidates(path: Path, name: str | None = None) -> list[tuple[str, Path]]:
    """Formats and describing files of what may be a data set, best first. name: the only format; None: any. Raises
    DatasetError for several recordings, each a file of its own."""
    if path.is_file():
        return [(name or recognize(path), path)]
    kinds = FORMATS if name is None else (name,)
    found = [(kind, file) for kind in kinds for file in find_files(path, reader(kind).FILES)]
    if len(found) > 1 and all(file.suffix in _RECORDINGS for _, file in found):
        raise DatasetError(f"{path}: holds {', '.join(file.name for _, file in found)}: name the file itself")
    return found


def find_format(path: Path) -> str:
    """The format of a describing file, or of a folder by its first describing file. Raises DatasetError."""
    for kind, _ in _candidates(path):
        return kind
    raise DatasetError(f"{path}: no data set or recording: no file or folder, or none of the known formats")


def open_dataset(path: Path, scale: float = 1.0, name: str | None = None) -> tuple[Path, Dataset]:
    """Open a data set, with alpha kept. Returns its describing file and its images.

    path: the describing file, or a folder, in which the first describing file whose images exist is taken.
    scale: image sizes are divided by it.
    name: the format; None recognizes it.
    Raises DatasetError.
    """
    if name is not None and name not in FORMATS:
        raise DatasetError(f"format {name!r}: expected one of {', '.join(FORMATS)}")
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    errors: list[str] = []
    for kind, file in _candidates(path, name):
        try:
            return file, reader(kind).load_dataset(file, ImageOptions(scale))
        except DatasetError as error:
            errors.append(str(error))
    if errors:
        raise DatasetError(errors[0])
    if name is not None:
        raise DatasetError(f"{path}: holds no data set of the format {name}")
    if (path / "cameras.xml").exists():
        raise DatasetError(f"{path}: holds cameras.xml, of metashape: convert it with ns-process-data metashape")
    raise DatasetError(
        f"{path}: holds no data set: expected transforms.json, transforms_*.json, the calibration JSON of "
        "videos, poses_bounds.npy, annots.npy, Eyeful's cameras.json, a COLMAP model, or an export of a depth camera "
        f"(rgb.txt, frame-000000.pose.txt, metadata.json, keyframes), or a ROS bag (metadata.yaml); {_OF_VIDEO}"
    )
