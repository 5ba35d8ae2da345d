"""The VR-NeRF Eyeful Tower data set: ``cameras.json`` and image folders.

``cameras.json`` holds ``{"KRT": [...]}`` with one entry an image: ``cameraId`` ("10/10_DSC0001", the image's
path without folder and extension), ``width`` and ``height`` of the full size, ``K`` (3 x 3) and ``T`` (4 x 4,
world to OpenCV camera axes, meters), both **column by column**, and ``distortionModel``: RadialAndTangential
[k1 k2 p1 p2 k3] or Fisheye [k1 k2 k3 - - - p1 p2] (equidistant). The data set's y points up; it becomes our
z.

The folders ``images-jpeg-1k`` to ``images-jpeg`` (full size) hold the images in several sizes;
``splits.json`` lists the test images. ``cameras.xml``, Metashape's own file, has no further information and
is not read.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, errors_at, path_within, read_array, read_json
from freshfield.geometry import Pose, se3_inverse

FILES = ("cameras.json",)
# Smallest first: more pixels than a field can learn in a second are of no use.
FOLDERS = ("images-jpeg-1k", "images-jpeg-2k", "images-jpeg-4k", "images-jpeg")
# (x, y up, z) -> (z, x, y): the height y becomes our z.
_UPRIGHT = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE, images: str | None = None) -> Dataset:
    """The images that have a file; the others are counted as missing. Cameras are named by their folders
    ("10").

    path: the scene's folder, or its ``cameras.json``.
    images: name of the folder of images (default: the smallest size present).

    Scenes are static; the n-th images of two cameras need not be from the same position of the rig.
    Raises DatasetError.
    """
    folder = path if path.is_dir() else path.parent
    file = path if path.is_file() else folder / FILES[0]
    entries = _entries(file)
    held_out = _held_out(folder / "splits.json")
    found = ImageFiles(_images(folder, images), options, str(file))
    for name, lens, camera_to_world in entries:
        pose, camera = _UPRIGHT @ camera_to_world, name.split("/")[0]
        found.add(name, name, lens, pose, f"{file}: {name}", endings=(".jpg", ".jpeg", ".png"), camera=camera)
    return found.dataset(held_out=held_out, per_camera=True)


def _images(folder: Path, images: str | None) -> Path:
    wanted = FOLDERS if images is None else (images,)
    for name in wanted:
        if (folder / name).is_dir():
            return folder / name
    raise DatasetError(f"{folder}: has no folder {' or '.join(wanted)}; download one, or name it as images")


def _held_out(file: Path) -> frozenset[str]:
    if not file.is_file():
        return frozenset()
    splits = read_json(file)
    test = splits.get("test") if isinstance(splits, dict) else None
    if not isinstance(test, list):
        raise DatasetError(f"{file}: expected a mapping with a list 'test'")
    return frozenset(str(name) for name in test)


def _entries(file: Path) -> list[tuple[str, Lens, np.ndarray]]:
    data = read_json(file)
    krt = data.get("KRT") if isinstance(data, dict) else None
    if not isinstance(krt, list) or not krt or not all(isinstance(entry, dict) for entry in krt):
        raise DatasetError(f"{file}: expected a mapping with a list 'KRT'")
    return [_entry(entry, f"{file}: KRT[{k}]") for k, entry in enumerate(krt)]


def _entry(entry: dict[str, Any], where: str) -> tuple[str, Lens, np.ndarray]:
    """An image's name ("10/10_DSC0001"), lens at full size, and camera-to-world in the set's own axes."""
    name = entry.get("cameraId")
    with errors_at(where):
        parts = path_within(name).parts if isinstance(name, str) else ()
    if not isinstance(name, str) or len(parts) != 2:
        raise DatasetError(f"{where}: cameraId is {name!r}, expected CAMERA/IMAGE")
    where = f"{where} ({name})"
    k, transform = read_array(entry, "K", (3, 3), where).T, read_array(entry, "T", (4, 4), where).T
    try:
        d = [float(v) for v in entry.get("distortion", [])]
        width, height = int(entry["width"]), int(entry["height"])
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DatasetError(f"{where}: width, height or distortion is wrong: {error}") from None
    model = entry.get("distortionModel")
    if model == "RadialAndTangential" and len(d) in (0, 5):
        k1, k2, p1, p2, k3 = d or [0.0] * 5
    elif model == "Fisheye" and len(d) in (0, 8):
        k1, k2, k3, _, _, _, p1, p2 = d or [0.0] * 8
    else:
        raise DatasetError(
            f"{where}: distortionModel {model!r} with {len(d)} coefficients; expected RadialAndTangential "
            "with 5 or Fisheye with 8"
        )
    with errors_at(where):
        Pose.from_matrix(transform)  # refuses a matrix that is not rigid, as se3_inverse needs it
        lens = Lens(width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], (k1, k2, k3), (p1, p2), model == "Fisheye")
    return name, lens, se3_inverse(transform)
