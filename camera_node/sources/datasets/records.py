"""The elements of a recorded data set: posed images that are read on demand, and common helpers."""

from __future__ import annotations

import contextlib
import difflib
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freshfield import untrusted
from freshfield.depth import DepthImage
from freshfield.geometry import GeometryError, Pinhole, se3_inverse

Image = NDArray[np.uint8]


class DatasetError(ValueError):
    """A data set that cannot be used. The message is one line: file, what was wrong, what to do."""


@dataclass(frozen=True, slots=True)
class PosedImage:
    """One posed image of a data set.

    name: the data set's own, unique within it.
    camera: name; "" in a set of photos taken by one moving camera.
    time_s: time in the recording; None if unknown.
    camera_to_world: float64 (4, 4), OpenCV axes, in the data set's units.
    intrinsics: of the image as ``read`` returns it.
    read: returns uint8 (H, W, 3) RGB or (H, W, 4) straight-alpha RGBA; raises DatasetError for a file that is
        damaged or has another size.
    path: the image's own file, if ``read`` does not scale, mask, turn or undistort it; else None.
    release: frees what ``read`` keeps open, such as a decoder.
    weight: returns float32 (H, W) in [0, 1], how much each pixel of the image may be learned from; None: all fully.
    depth: returns what a depth sensor measured with it; raises DatasetError. None: no sensor did.
    """

    name: str
    camera: str
    time_s: float | None
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole
    read: Callable[[], Image]
    path: Path | None = None
    release: Callable[[], None] = lambda: None
    weight: Callable[[], NDArray[np.float32]] | None = None
    depth: Callable[[], DepthImage] | None = None


@dataclass(frozen=True)
class Dataset:
    """A data set: its images, in its own order.

    missing: number of entries without a file.
    fps: rate of the recording; None if the data set does not tell.
    held_out: names of the data set's own test images.
    per_camera: each image belongs to the camera that took it, although nothing moves.
    carried: its one camera moved through a scene, and a tracker or robot gave the poses.
    notes: what a user should know of how the files were read, a sentence each.
    """

    images: tuple[PosedImage, ...]
    missing: int = 0
    fps: float | None = None
    held_out: frozenset[str] = frozenset()
    per_camera: bool = False
    carried: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """Raises DatasetError if two images have the same name."""
        for name, count in Counter(image.name for image in self.images).most_common(1):
            if count > 1:
                raise DatasetError(f"{count} of its entries are of the image {name}: keep one")

    def __len__(self) -> int:
        return len(self.images)

    def __iter__(self) -> Iterator[PosedImage]:
        return iter(self.images)

    def __getitem__(self, index: int) -> PosedImage:
        return self.images[index]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras in order of appearance; ("",) for a set of photos."""
        return tuple(dict.fromkeys(image.camera for image in self.images))

    @property
    def moving(self) -> bool:
        """Whether cameras and times are known, so that it is a recording of a moving scene."""
        return any(image.camera and image.time_s is not None for image in self.images)

    def of(self, camera: str) -> tuple[PosedImage, ...]:
        """The images of one camera, sorted by time."""
        found = [image for image in self.images if image.camera == camera]
        return tuple(sorted(found, key=lambda image: 0.0 if image.time_s is None else image.time_s))


_LONGEST_NAME = 255  # bytes of a file name, on every common file system
_LONGEST_PATH = 1000  # characters; systems allow 4096 bytes, including the folder and multi-byte characters


def path_within(name: str) -> Path:
    """The relative path of a file within a data set's folder; backslashes separate folders, too. Raises DatasetError
    if ``name`` leads out of the folder, or cannot be a file name."""
    name = name.replace("\\", "/")
    path = Path(name)
    if not name or path.is_absolute() or ".." in path.parts or (len(name) > 1 and name[1] == ":"):
        raise DatasetError(
            f"{name[:200]!r} does not lie within the folder of the data set: write it relative to that, images/0001.jpg"
        )
    if (
        "\0" in name
        or len(name) > _LONGEST_PATH
        or any(len(part.encode("utf-8", "replace")) > _LONGEST_NAME for part in path.parts)
    ):
        raise DatasetError(f"{name[:200]!r} is not the name of a file")
    return path


def file_within(folder: Path, name: str, endings: Sequence[str] = ("",)) -> Path | None:
    """The file ``name`` of a data set's folder, with the first of ``endings`` that exists; None: there is none. Raises
    DatasetError as ``path_within``, and for a symbolic link that leads out of the folder."""
    path = folder / path_within(name)
    found = next((file for end in endings if (file := path.with_name(path.name + end)).is_file()), None)
    if found is not None and not found.resolve().is_relative_to(folder.resolve()):
        raise DatasetError(
            f"{name[:200]!r} is a symbolic link that leads out of the data set: put the file itself there"
        )
    return found


def missing_note(names: Sequence[str], count: int, folder: Path) -> str:
    """A sentence on entries without a file: how many of ``count``, which first, and what was found beside it."""
    first = folder / names[0].replace("\\", "/")
    near = next(above for above in first.parents if above.is_dir())
    there = sorted(each.name for each in near.iterdir())
    close = [name for name in there if Path(name).stem == first.stem]
    close = close or difflib.get_close_matches(first.name, there, 3, 0.0)
    beside = ", ".join(close) or "nothing"
    more = f" and {len(there) - len(close)} more" if len(there) > len(close) else ""
    return f"{len(names)} of {count} images are missing, first {names[0]}; {near} holds {beside}{more}"


def find_files(folder: Path, patterns: Sequence[str]) -> list[Path]:
    """The files of a folder that match a pattern, in the order of the patterns, each once."""
    return list(dict.fromkeys(file for pattern in patterns for file in sorted(folder.glob(pattern))))


@contextlib.contextmanager
def errors_at(where: str) -> Iterator[None]:
    """Context in which a DatasetError or GeometryError becomes a DatasetError that begins with ``where``."""
    try:
        yield
    except (DatasetError, GeometryError) as error:
        raise DatasetError(f"{where}: {error}") from None


def read_json(file: Path) -> Any:
    """The contents of a JSON file. Raises DatasetError."""
    try:
        return untrusted.read_json(untrusted.read_text(file))
    except FileNotFoundError:
        raise DatasetError(f"{file}: no such file") from None
    except (OSError, ValueError) as error:
        raise DatasetError(f"{file}: cannot be read as JSON: {error}") from None


def read_array(entry: Mapping[str, Any], key: str, shape: tuple[int, ...], where: str) -> NDArray[np.float64]:
    """The finite numbers at ``key`` of a JSON object, reshaped to ``shape``.

    where: beginning of error messages.
    Raises DatasetError if they are missing, not finite numbers, or too many or few.
    """
    try:
        value = np.array(entry[key], dtype=np.float64)
    except KeyError:
        raise DatasetError(f"{where}: {key} is missing") from None
    except (ValueError, TypeError, OverflowError):
        raise DatasetError(f"{where}.{key}: expected numbers") from None
    if value.size != math.prod(shape) or not np.all(np.isfinite(value)):
        raise DatasetError(f"{where}.{key}: expected finite numbers of shape {shape}, got {value.shape}")
    return value.reshape(shape)


def camera_to_world(rotation: ArrayLike, translation: ArrayLike) -> NDArray[np.float64]:
    """Camera-to-world matrix (4, 4) from the world-to-camera rotation (3, 3) and translation (3,)."""
    world_to_camera = np.eye(4)
    world_to_camera[:3, :3] = rotation
    world_to_camera[:3, 3] = translation
    return se3_inverse(world_to_camera)
