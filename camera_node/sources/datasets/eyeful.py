"""The VR-NeRF Eyeful Tower data set: ``cameras.json`` (or Metashape's ``cameras.xml``) and image folders.

``cameras.json`` holds ``{"KRT": [...]}`` with an entry an image: ``cameraId`` ("10/10_DSC0001", its path
without folder and extension), ``width`` and ``height`` of the full size, ``K`` (3 x 3) and ``T`` (4 x 4,
world to OpenCV camera axes), both **column by column**, and ``distortionModel``: RadialAndTangential [k1 k2
p1 p2 k3] or Fisheye [k1 k2 k3 - - - p1 p2] (equidistant). The world's y points up and becomes our z here;
meters.

``cameras.xml`` holds the same as Metashape wrote it: OpenCV camera axes in a chunk with a transform
of its own, tangential coefficients in the other order, principal points from the center. The images stand
scaled in ``images-jpeg-1k`` to ``images-jpeg`` (full size); ``splits.json`` names those for testing.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.config import EyefulConfig
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions, Photo, lens_for_image, posed_photo
from camera_node.sources.datasets.records import (
    Dataset,
    DatasetError,
    PosedImage,
    errors_at,
    find_files,
    path_within,
    read_array,
    read_json,
)
from freshfield.geometry import se3_inverse

FILES = ("cameras.json", "cameras.xml")
# Smallest first: more pixels than a field learns in a second are of no use.
FOLDERS = ("images-jpeg-1k", "images-jpeg-2k", "images-jpeg-4k", "images-jpeg")
# (x, y up, z) -> (z, x, y): the height y becomes our z.
_UPRIGHT = np.array([[0.0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])


@dataclass(frozen=True)
class _Entry:
    """One image: its name ("10/10_DSC0001"), lens at full size, camera-to-world in the set's own axes."""

    name: str
    lens: Lens
    camera_to_world: np.ndarray


def describes(file: Path) -> bool:
    """See ``formats.Reader``."""
    data = read_json(file) if file.suffix == ".json" else None
    return file.suffix == ".xml" or (isinstance(data, dict) and "KRT" in data)


def from_config(path: Path, config: EyefulConfig) -> Dataset:
    """See ``formats.Reader``."""
    return load_dataset(path, ImageOptions(config.scale), config.images)


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE, images: str | None = None) -> Dataset:
    """The images that have a file; cameras are named by their folders ("10").

    path: the scene's folder, its ``cameras.json`` or its ``cameras.xml``.
    images: folder of images (default: the smallest there is).

    Nothing in a scene moves, and a camera shows its own images, not necessarily those of one position at a
    time. Images without a file are left out and counted. Raises DatasetError.
    """
    folder = path if path.is_dir() else path.parent
    file = path if path.is_file() else next(iter(find_files(folder, FILES)), folder / FILES[0])
    entries = _from_xml(file) if file.suffix == ".xml" else _from_json(file)
    held_out = _held_out(folder / "splits.json")
    pictures = _images(folder, images)
    lenses: dict[Lens, Lens] = {}
    found: list[PosedImage] = []
    missing = 0
    for entry in entries:
        image = next(
            (f for s in (".jpg", ".jpeg", ".png") if (f := pictures / f"{entry.name}{s}").is_file()), None
        )
        if image is None:
            missing += 1
            continue
        where = f"{file}: {entry.name}"
        if entry.lens not in lenses:
            lenses[entry.lens] = lens_for_image(entry.lens, image, where)
        photo = Photo(image, lenses[entry.lens], options)
        pose = _UPRIGHT @ entry.camera_to_world
        found.append(posed_photo(photo, entry.name, pose, where, entry.name.split("/")[0]))
    if not found:
        raise DatasetError(f"{file}: none of its {missing} images exists in {pictures}")
    held_out &= {image.name for image in found}
    return Dataset(tuple(found), missing, held_out=held_out, per_camera=True)


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


def _from_json(file: Path) -> list[_Entry]:
    data = read_json(file)
    krt = data.get("KRT") if isinstance(data, dict) else None
    if not isinstance(krt, list) or not krt or not all(isinstance(entry, dict) for entry in krt):
        raise DatasetError(f"{file}: expected a mapping with a list 'KRT'")
    return [_entry(entry, f"{file}: KRT[{k}]") for k, entry in enumerate(krt)]


def _entry(entry: dict[str, Any], where: str) -> _Entry:
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
    except (KeyError, TypeError, ValueError) as error:
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
        lens = Lens(
            width, height, k[0, 0], k[1, 1], k[0, 2], k[1, 2], (k1, k2, k3), (p1, p2), model == "Fisheye"
        )
    return _Entry(name, lens, se3_inverse(transform))


def _from_xml(file: Path) -> list[_Entry]:
    try:
        root = ET.parse(file).getroot()
    except FileNotFoundError:
        raise DatasetError(f"{file}: no such file") from None
    except (OSError, ET.ParseError) as error:
        raise DatasetError(f"{file}: cannot be read as XML: {error}") from None
    chunk = root.find("chunk")
    if chunk is None:
        raise DatasetError(f"{file}: has no chunk: is it Metashape's cameras.xml?")
    sensors = {sensor.get("id"): sensor for sensor in chunk.iterfind("sensors/sensor")}
    places = {
        part.get("id"): _place(part.find("transform"), file)
        for part in chunk.iterfind("components/component")
    }
    whole = _place(chunk.find("transform"), file)
    entries: list[_Entry] = []
    for camera in chunk.iterfind("cameras//camera"):
        label = (camera.get("label") or "").rsplit(".", 1)[0]
        where = f"{file}: camera {label!r}"
        transform = camera.find("transform")
        if transform is None:
            if camera.get("master_id") is not None:
                raise DatasetError(
                    f"{where}: is placed by its rig's master; use cameras.json, which places every image"
                )
            continue  # an image that Metashape could not place
        scale, place = places.get(camera.get("component_id"), whole)
        pose = _numbers(transform, 16, where).reshape(4, 4)
        pose[:3, 3] *= scale
        sensor = sensors.get(camera.get("sensor_id"))
        if sensor is None:
            raise DatasetError(f"{where}: its sensor {camera.get('sensor_id')} is missing")
        name = label if "/" in label else f"{label.split('_')[0]}/{label}"
        entries.append(_Entry(name, _sensor(sensor, where), place @ pose))
    if not entries:
        raise DatasetError(f"{file}: places no camera")
    return entries


def _place(transform: ET.Element | None, file: Path) -> tuple[float, np.ndarray]:
    """Scale, then rigid motion, that take a part's coordinates to the world's."""
    out = np.eye(4)
    if transform is None:
        return 1.0, out
    parts = {name: transform.find(name) for name in ("rotation", "translation", "scale")}
    if parts["rotation"] is not None:
        out[:3, :3] = _numbers(parts["rotation"], 9, f"{file}: rotation").reshape(3, 3)
    if parts["translation"] is not None:
        out[:3, 3] = _numbers(parts["translation"], 3, f"{file}: translation")
    return 1.0 if parts["scale"] is None else float(_numbers(parts["scale"], 1, f"{file}: scale")[0]), out


def _sensor(sensor: ET.Element, where: str) -> Lens:
    calibration = sensor.find("calibration")
    size = None if calibration is None else calibration.find("resolution")
    if calibration is None or size is None:
        raise DatasetError(f"{where}: its sensor has no calibration")
    value = {item.tag: float(_numbers(item, 1, where)[0]) for item in calibration if item.tag in _KNOWN}
    kind = calibration.get("type", sensor.get("type", "frame"))
    if kind not in ("frame", "fisheye", "equidistant_fisheye"):
        raise DatasetError(f"{where}: its sensor is of type {kind!r}, expected frame or fisheye")
    if value.get("b2"):
        raise DatasetError(f"{where}: its sensor has skew (b2), which no camera here has")
    try:
        width, height = int(size.get("width", "")), int(size.get("height", ""))
        f, of = value["f"], value.get
        return Lens(
            width, height, f + of("b1", 0.0), f, width / 2 + of("cx", 0.0), height / 2 + of("cy", 0.0),
            tuple(of(name, 0.0) for name in ("k1", "k2", "k3", "k4")),
            (of("p2", 0.0), of("p1", 0.0)),  # theirs stand the other way round
            kind != "frame",
        )  # fmt: skip
    except (KeyError, ValueError) as error:
        raise DatasetError(f"{where}: its sensor's calibration is wrong: {error}") from None


_KNOWN = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")


def _numbers(item: ET.Element | None, count: int, where: str) -> np.ndarray:
    try:
        values = np.array([float(v) for v in ((item.text if item is not None else "") or "").split()])
    except ValueError:
        values = np.zeros(0)
    if len(values) != count or not all(map(math.isfinite, values)):
        raise DatasetError(f"{where}: expected {count} numbers")
    return values
