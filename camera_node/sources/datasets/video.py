"""Synchronized videos with a calibration JSON, as a data set with one image for every frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from camera_node.sources.datasets.imaging import shrink
from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions
from camera_node.sources.datasets.records import Dataset, DatasetError, PosedImage, errors_at, find_files, path_within
from camera_node.sources.datasets.video_clip import Clip
from camera_node.sources.rig_calibration import CalibratedCamera, load_calibration
from freshfield.geometry import Pinhole

FILES = ("calib*.json",)
_PLACES = ("videos/{}.mp4", "{}.mp4")


@dataclass(frozen=True)
class VideoRig:
    """Synchronized videos. cameras: calibration at full size, by name. files: video file, by name."""

    cameras: dict[str, CalibratedCamera]
    files: dict[str, Path]


def load_rig(path: Path, files: Mapping[str, str] | None = None) -> VideoRig:
    """The rig of a calibration JSON, or of the only one in a folder; cameras without a video are left out.

    files: camera to video file, relative to the JSON, for videos that are not at ``_PLACES``.
    Raises DatasetError.
    """
    calibration = path if path.is_file() else _find_calibration(path)
    cameras, files = load_calibration(calibration), files or {}
    for name in files:
        if name not in cameras:
            raise DatasetError(f"{calibration}: has no camera {name!r}, for which a video is named")
    found: dict[str, Path] = {}
    for name in cameras:
        if name in files:
            places = [files[name]]
        else:
            with errors_at(str(calibration)):
                places = [str(path_within(p.format(name))) for p in _PLACES]
        video = next((calibration.parent / p for p in places if (calibration.parent / p).is_file()), None)
        if video is not None:
            found[name] = video
        elif name in files:
            raise DatasetError(f"{calibration.parent / places[0]}: no such video (camera {name})")
    if not found:
        raise DatasetError(f"{calibration}: none of its cameras has a video at {' or '.join(_PLACES)}")
    return VideoRig({name: cameras[name] for name in found}, found)


def load_dataset(path: Path, options: ImageOptions = FULL_SIZE) -> Dataset:
    """``rig_dataset`` of a calibration JSON, or of the only one in a folder. Raises DatasetError."""
    return rig_dataset(load_rig(path), path, options.scale)


def rig_dataset(rig: VideoRig, path: Path, scale: float) -> Dataset:
    """Every frame of every video as an image that is read on demand, one camera after the other.

    Poses are those of the calibration. All videos are cut to the length of the shortest.
    path: for error messages. scale: image sizes are divided by it.
    Raises DatasetError if a pose is missing, or a video cannot be opened.
    """
    clips = {name: open_clip(rig, name) for name in rig.cameras}
    count = min(clip.count for clip in clips.values())
    images: list[PosedImage] = []
    for name, clip in clips.items():
        calibrated = rig.cameras[name]
        if calibrated.pose is None:
            raise DatasetError(f"{path}: {name}: R_world_to_cam is missing")
        small = shrink(calibrated.intrinsics, scale)
        matrix = calibrated.pose.matrix()
        for index in range(count):
            images.append(
                PosedImage(
                    name=f"{name}/{index:04d}",
                    camera=name,
                    time_s=index / clip.fps,
                    camera_to_world=matrix,
                    intrinsics=small,
                    read=partial(clip.frame, index, small.width, small.height),
                )
            )
    return Dataset(tuple(images), 0, next(iter(clips.values())).fps)


def open_clip(rig: VideoRig, name: str) -> Clip:
    """Open a camera's video. Raises DatasetError if it cannot be opened, or its size is not the
    calibration's."""
    clip = Clip(rig.files[name])
    expected: Pinhole = rig.cameras[name].intrinsics
    if (clip.width, clip.height) != (expected.width, expected.height):
        raise DatasetError(
            f"{clip.path}: video is {clip.width} x {clip.height}, calibrated for {expected.width} x {expected.height}"
        )
    return clip


def _find_calibration(folder: Path) -> Path:
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such file or folder")
    found = find_files(folder, FILES)
    if len(found) != 1:
        names = ", ".join(p.name for p in found) or "none"
        raise DatasetError(f"{folder}: expected one calib*.json, found {names}; name the file itself")
    return found[0]
