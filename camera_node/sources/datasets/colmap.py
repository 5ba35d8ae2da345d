"""COLMAP models as text or binary (COLMAP's documentation, "Output Format"), with their images.

The files' poses are world-to-camera with OpenCV axes and w-first quaternions; their pixel origin is the
image's corner, as in this project. The model is in the folder itself or in ``sparse/0``, ``sparse`` or
``colmap/sparse/0``, its images in ``images`` beside it, or in a folder of smaller ones (``images_4``). Points
are not read.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import (
    Dataset,
    DatasetError,
    camera_to_world,
    errors_at,
    file_within,
    find_files,
)
from freshfield.geometry import quaternion_to_matrix
from freshfield.untrusted import read_bytes, read_text

_PLACES = ("", "sparse/0/", "sparse/", "colmap/sparse/0/")
# At each place binary files are preferred, as COLMAP does.
FILES = tuple(f"{place}cameras{ending}" for place in _PLACES for ending in (".bin", ".txt"))
# Supported camera models: COLMAP's number of the model, its name, and its number of parameters.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
}


@dataclass(frozen=True)
class _Image:
    """name: path below the folder of images. pose: quaternion (w-first) and translation, world to camera."""

    name: str
    camera: int
    pose: tuple[float, ...]


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE, images: str | None = None) -> Dataset:
    """The model's images that have a file, sorted by name; the others are counted as missing.

    path: the data set's folder, or a file of the model.
    images: name of the folder of images, beside the model or above it (default ``images``, else the data
        set's folder itself).
    Raises DatasetError.
    """
    files = find_files(path, FILES) if path.is_dir() else [path.with_name(f"cameras{path.suffix}")]
    file = next((f for f in files if f.is_file() and f.with_stem("images").is_file()), None)
    if file is None:
        raise DatasetError(f"{path}: no COLMAP model: expected cameras and images, .bin or .txt, in it or in sparse/0")
    lenses, entries = (_binary if file.suffix == ".bin" else _text)(file)
    root = path if path.is_dir() else path.parent
    folder = _images(root, file, images)
    found = ImageFiles(folder, options, str(file.with_stem("images")))
    for image in sorted(entries, key=lambda i: i.name):
        where = f"{file.with_stem('images')}: {image.name}"
        if image.camera not in lenses:
            raise DatasetError(f"{where}: its camera {image.camera} is not in {file.name}")
        with errors_at(where):
            mask = _mask(folder, root, image.name)
            pose = camera_to_world(quaternion_to_matrix(image.pose[:4]), image.pose[4:])
        ignored = (mask, True) if mask else None
        found.add(image.name, image.name, lenses[image.camera], pose, where, ignored=ignored)
    return found.dataset()


def _mask(folder: Path, root: Path, name: str) -> Path | None:
    """The mask of an image in the folder ``masks`` beside that of the images: a.jpg.png, or a.png; zero where nothing
    may be learned."""
    beside = folder if folder == root else folder.parent
    found = file_within(beside, f"masks/{name}", (".png",))
    return found or file_within(beside, f"masks/{name.rpartition('.')[0] or name}.png")


def _images(given: Path, model: Path, images: str | None) -> Path:
    above = list(dict.fromkeys([given, *model.parents[:4]]))
    for folder in above:
        if (folder / (images or "images")).is_dir():
            return folder / (images or "images")
    if images is not None:
        raise DatasetError(f"{given}: no folder {images} beside the model or above it")
    return given


def _lens(model: str, width: int, height: int, p: list[float], where: str) -> Lens:
    """Parameters in COLMAP's order as a lens. Raises DatasetError."""
    counts = dict(_MODELS.values())
    if model not in counts:
        raise DatasetError(f"{where}: camera model {model}: expected one of {', '.join(counts)}; undistort the images")
    if len(p) != counts[model]:
        raise DatasetError(f"{where}: {model} has {counts[model]} parameters, not {len(p)}")
    if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE"):
        (fx, fy, cx, cy), rest = p[:4], p[4:]
    else:
        (fx, cx, cy), rest = p[:3], p[3:]
        fy = fx
    fisheye = model.endswith("FISHEYE")
    radial = rest[:2] if model == "OPENCV" else rest
    tangential = (rest[2], rest[3]) if model == "OPENCV" else (0.0, 0.0)
    with errors_at(where):
        return Lens(width, height, fx, fy, cx, cy, tuple(radial), tangential, fisheye)


# --- text -----------------------------------------------------------------------------------------


def _text(file: Path) -> tuple[dict[int, Lens], list[_Image]]:
    lenses: dict[int, Lens] = {}
    for number, line in _lines(file):
        if not line or line.startswith("#"):
            continue
        where, words = f"{file}:{number}", line.split()
        try:
            size, params = (int(words[2]), int(words[3])), [float(v) for v in words[4:]]
            lenses[int(words[0])] = _lens(words[1], *size, params, where)
        except (IndexError, ValueError) as error:
            if isinstance(error, DatasetError):
                raise
            raise DatasetError(f"{where}: expected CAMERA_ID MODEL WIDTH HEIGHT PARAMS...") from None
    images: list[_Image] = []
    lines = iter(_lines(file.with_stem("images")))
    for number, line in lines:
        if not line or line.startswith("#"):
            continue
        words = line.split(maxsplit=9)
        try:
            pose = tuple(float(v) for v in words[1:8])
            images.append(_Image(words[9], int(words[8]), pose))
        except (IndexError, ValueError):
            raise DatasetError(
                f"{file.with_stem('images')}:{number}: expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"
            ) from None
        if len(next(lines, (0, "missing"))[1].split()) % 3:  # two coordinates and the number of a point each
            raise DatasetError(f"{file.with_stem('images')}:{number}: the line of {words[9]}'s points is missing: cut?")
    return lenses, images


def _lines(file: Path) -> list[tuple[int, str]]:
    try:
        return [(k + 1, line.strip()) for k, line in enumerate(read_text(file).split("\n"))]
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"{file}: cannot be read: {error}") from None


# --- binary ---------------------------------------------------------------------------------------


class _Bytes:
    """A binary file, little-endian, read from front to back. Beyond its end struct.error or ValueError is raised."""

    def __init__(self, file: Path) -> None:
        self._data, self._at = read_bytes(file), 0

    def take(self, layout: str) -> tuple[Any, ...]:
        """The next fields, in the format characters of ``struct``."""
        fields = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return fields

    def name(self) -> str:
        """Text up to a zero byte."""
        text = self._data[self._at : self._data.index(b"\0", self._at)]
        self._at += len(text) + 1
        return text.decode()

    def left(self) -> int:
        return len(self._data) - self._at


Entry = TypeVar("Entry")


def _entries(file: Path, read: Callable[[_Bytes], Entry]) -> list[Entry]:
    """What ``read`` makes of each of a file's entries. Raises DatasetError."""
    try:
        data = _Bytes(file)
        found = [read(data) for _ in range(data.take("Q")[0])]
    except DatasetError:
        raise
    except (OSError, struct.error, ValueError) as error:
        raise DatasetError(f"{file}: cannot be read as a COLMAP model: {error}; cut short?") from None
    if data.left():
        raise DatasetError(f"{file}: {data.left()} bytes follow its last entry: no COLMAP model?")
    return found


def _binary(file: Path) -> tuple[dict[int, Lens], list[_Image]]:
    def camera(data: _Bytes) -> tuple[int, Lens]:
        number, model, width, height = data.take("iiQQ")
        name, count = _MODELS.get(model, (str(model), 0))
        return number, _lens(name, width, height, list(data.take(f"{count}d")), f"{file}: camera {number}")

    def image(data: _Bytes) -> _Image:
        _, *pose, camera = data.take("I7dI")
        name = data.name()
        data.take(f"{24 * data.take('Q')[0]}x")  # two coordinates and the number of a point each
        return _Image(name, camera, tuple(pose))

    return dict(_entries(file, camera)), _entries(file.with_stem("images"), image)
