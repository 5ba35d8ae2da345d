"""Data sets described by a ``transforms.json``: nerfstudio, instant-ngp, NeRF-synthetic, and what writes like them.

Poses are camera-to-world with OpenGL camera axes, converted to OpenCV's here. Intrinsics are given per file
or per frame (``transforms_keys``); their pixel origin is the image's corner, as in COLMAP. If frames have a ``time``
and a camera (a key of ``CAMERA_NAMES``, or a folder of images for each), the data set is a recording of a moving scene
by several cameras. ``transforms_test.json`` beside ``transforms_train.json``, and the file names of a split, are the
data set's own test images.
"""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any, get_args

import numpy as np

from camera_node.settings import Background
from camera_node.sources.datasets.image_reading import image_size
from camera_node.sources.datasets.lens import Lens
from camera_node.sources.datasets.photo import FULL_SIZE, ImageFiles, ImageOptions, NoImages
from camera_node.sources.datasets.records import (
    Dataset,
    DatasetError,
    errors_at,
    file_within,
    find_files,
    path_within,
    read_array,
    read_json,
)
from camera_node.sources.datasets.rgbd.depth_file import DepthFile
from camera_node.sources.datasets.transforms_keys import CAMERA_NAMES, check_keys, unknown_note
from freshfield.geometry import OPENGL_TO_OPENCV

# First the files from which nerfstudio and NeRF-synthetic start a training.
FILES = ("transforms.json", "transforms_train.json", "transforms*.json")
TRAIN, TEST = "transforms_train.json", "transforms_test.json"
EXTENSIONS = ("", ".png", ".jpg", ".jpeg", ".PNG", ".JPG", ".JPEG")
_STRAIGHT = ("OPENCV", "PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
_FISHEYE = ("OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """The images of a transforms JSON, or of the first one in a folder that has images.

    Entries without an image file are counted as missing. Raises DatasetError.
    """
    if options.background not in get_args(Background):
        raise DatasetError(f"background is {options.background!r}: expected one of {', '.join(get_args(Background))}")
    if not path.exists():
        raise DatasetError(f"{path}: no such file or folder")
    tried = []
    for file in [path] if path.is_file() else find_files(path, FILES):
        try:
            return _load(file, options)
        except NoImages as error:
            tried.append(str(error))
    raise DatasetError("; ".join(tried) or f"{path}: no transforms JSON")


def _load(file: Path, options: ImageOptions) -> Dataset:
    data, frames = _read(file)
    test = file.with_name(TEST)
    listed = [(data, frame, f"{file}: frames[{k}]") for k, frame in enumerate(frames)]
    tests = [(data, frame, f"{file}: test_frames[{k}]") for k, frame in enumerate(_frames(data, "test_frames", file))]
    if file.name == TRAIN and test.is_file():
        more, frames = _read(test)
        tests += [(more, frame, f"{test}: frames[{k}]") for k, frame in enumerate(frames)]
        data = {**more, **data}
    held_out = {_name(frame, where) for _, frame, where in tests}
    listed += tests
    split, left_out = _split(data, {_name(frame, where) for _, frame, where in listed}, str(file))
    held_out |= split
    bad = [where for _, frame, where in listed if frame.get("is_bad")]
    listed = [each for each in listed if not each[1].get("is_bad") and _name(*each[1:]) not in left_out]
    cameras, notes = _cameras([frame for _, frame, _ in listed], str(file))
    if bad and not listed:
        notes.append(f"{len(bad)} of its frames are marked is_bad, and none is left")
    unknown = check_keys(data, str(file)).union(*(check_keys(frame, where) for _, frame, where in listed))
    found = ImageFiles(file.parent, options, str(file))
    without_depth: list[Path] = []
    sizes: dict[str, tuple[int, int]] = {}
    for (top, frame, where), camera in zip(listed, cameras):
        name = _name(frame, where)
        image = found.path(name, where, EXTENSIONS)
        if image is None:
            continue
        lens = _lens({**top, **frame}, image, sizes, camera, where)
        depth = _depth(file.parent, {**top, **frame}, where)
        if depth is not None and not depth.path.is_file():
            without_depth.append(depth.path)
            depth = None
        ignored = _ignored(file.parent, {**top, **frame}, image, where)
        time_s, reader = _number(frame, "time", where) if "time" in frame else None, depth.read if depth else None
        pose = _pose(frame, where)
        found.add(name, image, lens, pose, where, camera=camera, time_s=time_s, ignored=ignored, depth=reader)
    if without_depth:
        notes.append(f"{len(without_depth)} of its depth files are missing, first {without_depth[0]}")
    if unknown:
        notes.append(unknown_note(unknown))
    fps = _number(data, "fps", str(file)) if "fps" in data else None
    return found.dataset(fps, notes, held_out)


def _read(file: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    data = read_json(file)
    if not isinstance(data, dict) or "frames" not in data:
        raise DatasetError(f"{file}: expected a mapping with a list 'frames'")
    data = _without_null(data)
    return data, _frames(data, "frames", file)


def _frames(data: dict[str, Any], key: str, file: Path) -> list[dict[str, Any]]:
    frames = data.get(key, [])
    if not isinstance(frames, list) or not all(isinstance(f, dict) for f in frames):
        raise DatasetError(f"{file}: expected a mapping with a list '{key}' of mappings")
    return [_without_null(frame) for frame in frames]


def _without_null(entry: dict[str, Any]) -> dict[str, Any]:
    """A key whose value is null is as good as absent."""
    return {key: value for key, value in entry.items() if value is not None}


def _name(frame: dict[str, Any], where: str) -> str:
    """The image's path below the folder."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise DatasetError(f"{where}: 'file_path' is missing")
    with errors_at(where):
        return path_within(name).as_posix()


def _split(data: dict[str, Any], names: set[str], where: str) -> tuple[set[str], set[str]]:
    """The images that the file's own split tests on, and those that it leaves out. names: of all images."""
    lists: dict[str, set[str]] = {}
    for part in ("train", "test", "val"):
        listed = data.get(f"{part}_filenames", [])
        if not isinstance(listed, list) or not all(isinstance(name, str) for name in listed):
            raise DatasetError(f"{where}: {part}_filenames: expected a list of file names")
        with errors_at(f"{where}: {part}_filenames"):
            lists[part] = {path_within(name).as_posix() for name in listed}
        if unknown := sorted(lists[part] - names):
            raise DatasetError(f"{where}: {part}_filenames: {unknown[0]} is no file_path of its frames")
    test = lists["test"] or lists["val"]
    return test, ((names - lists["train"]) if lists["train"] else lists["val"]) - test


def _cameras(frames: Sequence[dict[str, Any]], where: str) -> tuple[list[str], list[str]]:
    """The name of each frame's camera ("" without), and notes. Raises DatasetError for a recording of which it is not
    known which images belong to one instant."""
    named = [str(next((frame[key] for key in CAMERA_NAMES if key in frame), "")) for frame in frames]
    times = [frame["time"] for frame in frames if "time" in frame]
    if not frames:
        return [], []
    if not times:
        poses = {repr(frame.get("transform_matrix")) for frame in frames}
        if 2 * len(poses) > len(frames):
            return named, []
        return named, [
            f"{len(frames)} images have {len(poses)} poses and no time: taken for a scene that stands still; if it "
            "moves, give each frame its time and camera"
        ]
    if len(times) < len(frames):
        raise DatasetError(f"{where}: {len(frames) - len(times)} of {len(frames)} frames have no time")
    if len(set(map(repr, times))) == 1 or all(named):
        return named, []
    if any(named):
        raise DatasetError(f"{where}: {named.count('')} of {len(frames)} frames have a time and no camera")
    # One folder of images for each camera says the same as a key.
    folders = [_name(frame, where).rpartition("/")[0] for frame in frames]
    instants: dict[str, set[str]] = {}
    for folder, time in zip(folders, map(repr, times)):
        instants.setdefault(folder, set()).add(time)
    shared, every = set.intersection(*instants.values()), set.union(*instants.values())
    once = Counter(zip(folders, map(repr, times))).most_common(1)[0][1] == 1
    if len(instants) > 1 and once and 2 * len(shared) >= len(every):
        # What tells them apart: cam00 of images/cam00, and of cam00/images.
        parts = [set(part) for part in zip(*(folder.split("/")[::-1] for folder in instants))]
        k = next((k for k, part in enumerate(parts) if len(part) == len(instants)), None)
        return [folder if k is None else folder.split("/")[-1 - k] for folder in folders], []
    alone = max(Counter(map(repr, times)).values()) == 1
    if alone and not all(0 <= _number(frame, "time", where) <= 1 for frame in frames):
        return named, [
            f"{len(frames)} images of one moving camera, each with its own time: taken for a scene that stands still"
        ]
    raise DatasetError(
        f"{where}: the frames have {len(every)} different times and no camera, "
        + ("so that there is one view of each instant, which no field can be fitted to" if alone else "so that ")
        + ("" if alone else "it is not known which camera took which")
        + ": give each frame its camera, or leave out time if nothing moves"
    )


def _ignored(folder: Path, d: dict[str, Any], image: Path, where: str) -> tuple[Path, bool] | None:
    """``Photo.ignored``: nerfstudio's masks are zero where nothing may be learned, instant-ngp's elsewhere."""
    name = d.get("mask_path")
    if not name:
        beside = image.with_name(f"dynamic_mask_{image.stem}.png")
        return (beside, False) if beside.is_file() else None
    with errors_at(f"{where}: mask_path"):
        mask = file_within(folder, str(name))
        if mask is None:
            raise DatasetError(f"{str(name)[:200]!r} is missing")
    return mask, True


def _depth(folder: Path, d: dict[str, Any], where: str) -> DepthFile | None:
    """The frame's depth: nerfstudio's keys, or instant-ngp's."""
    name = d.get("depth_file_path") or d.get("depth_path")
    if not name:
        return None
    key = next((key for key in ("depth_unit_scale_factor", "integer_depth_scale") if key in d), None)
    unit_m = None if key is None else _number(d, key, where)
    if unit_m is not None and not 0.0 < unit_m <= 1e3:
        raise DatasetError(f"{where}: {key} is {unit_m:g}: expected the meters of a 1 in the files, such as 0.001")
    with errors_at(f"{where}: depth_file_path"):
        found = file_within(folder, str(name))
        return DepthFile(found or folder / path_within(str(name)), unit_m)


def _pose(frame: dict[str, Any], where: str) -> np.ndarray:
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
        if matrix.shape == (3, 4):
            matrix = np.vstack([matrix, [0.0, 0.0, 0.0, 1.0]])
        if matrix.shape != (4, 4):
            raise ValueError(f"its shape is {matrix.shape}")
        if not np.isfinite(matrix).all():  # numpy would warn of it below, beside the error
            raise ValueError("its numbers are not finite")
        return matrix @ OPENGL_TO_OPENCV
    except KeyError:
        raise DatasetError(f"{where}: 'transform_matrix' is missing") from None
    except (ValueError, TypeError, OverflowError) as error:
        raise DatasetError(f"{where}: transform_matrix is no camera-to-world matrix: {error}") from None


def _lens(d: dict[str, Any], image: Path, sizes: dict[str, tuple[int, int]], camera: str, where: str) -> Lens:
    model = str(d.get("camera_model", "OPENCV")).upper()
    if model not in (*_STRAIGHT, *_FISHEYE):
        raise DatasetError(
            f"{where}: camera_model {d['camera_model']!r:.60} is no lens that is read: undistort the images"
        )
    fisheye = d.get("is_fisheye", model in _FISHEYE)
    if fisheye not in (True, False):
        raise DatasetError(f"{where}: is_fisheye is {fisheye!r:.60}, expected true or false")
    if "camera_model" in d and fisheye != (model in _FISHEYE):
        raise DatasetError(
            f"{where}: is_fisheye and camera_model {model} contradict each other: leave out what is wrong"
        )
    if "w" in d and "h" in d:
        width, height = int(_number(d, "w", where)), int(_number(d, "h", where))
    else:
        width, height = image_size(image)
        if ("fl_x" in d or "cx" in d) and sizes.setdefault(camera, (width, height)) != (width, height):
            raise DatasetError(
                f"{where}: image of {width} x {height}, others have {sizes[camera][0]} x {sizes[camera][1]}: give w "
                "and h, the size that fl_x and cx belong to"
            )
    fx, fy = _focal(d, "x", width, where), _focal(d, "y", height, where)
    fx = fy if fx is None else fx
    fy = fx if fy is None else fy
    if fx is None or fy is None:
        raise DatasetError(f"{where}: neither 'fl_x' nor 'camera_angle_x' is given")
    if width < 1 or height < 1 or not (fx > 0 and fy > 0):
        raise DatasetError(f"{where}: size {width} x {height}, focal lengths {fx:g}, {fy:g} are impossible")
    names = ("k1", "k2", "k3", "k4", "p1", "p2")
    bends = [_number(d, name, where) if name in d else 0.0 for name in names]
    if d.get("distortion_params"):
        bends = read_array(d, "distortion_params", (6,), where).tolist()
    if fisheye and any(bends[4:]):
        raise DatasetError(f"{where}: p1 and p2 belong to no fisheye lens: undistort the images and leave them out")
    cx = _number(d, "cx", where) if "cx" in d else width / 2.0
    cy = _number(d, "cy", where) if "cy" in d else height / 2.0
    with errors_at(where):
        return Lens(width, height, fx, fy, cx, cy, tuple(bends[:4]), (bends[4], bends[5]), bool(fisheye))


def _focal(d: dict[str, Any], axis: str, side: int, where: str) -> float | None:
    """The focal length along an axis in pixels: given, or by the angle of view in radians, or in degrees."""
    if f"fl_{axis}" in d:
        return _number(d, f"fl_{axis}", where)
    for key, unit, name in ((f"{axis}_fov", math.pi / 180.0, "degrees"), (f"camera_angle_{axis}", 1.0, "radians")):
        if key in d:
            angle = _number(d, key, where) * unit
            if not 0 < angle < math.pi:
                raise DatasetError(f"{where}: {key} is {d[key]:g}, expected {name} of an angle from 0 to pi")
            return 0.5 * side / math.tan(0.5 * angle)
    return None


def _number(d: dict[str, Any], key: str, where: str) -> float:
    value = d[key]
    # Compared, not converted: an integer of hundreds of digits fits no float.
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) <= sys.float_info.max:
        raise DatasetError(f"{where}: {key} is {value!r:.60}, expected a number")
    return float(value)
