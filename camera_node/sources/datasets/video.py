"""Synchronized videos with a calibration JSON, as a data set with one image for every frame."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.sources import source_constants as tuned
from camera_node.sources.base import rate
from camera_node.sources.calibration_file import CalibratedCamera, load_calibration
from camera_node.sources.datasets.image_reading import as_image, resize, shrink
from camera_node.sources.datasets.photo import FULL_SIZE, ImageOptions
from camera_node.sources.datasets.records import (
    Dataset,
    DatasetError,
    Image,
    PosedImage,
    errors_at,
    file_within,
    find_files,
)
from freshfield.geometry import Pinhole

FILES = ("calib*.json", "rig*.json")  # a folder's rig*.json counts where it has no calib*.json
_PLACES = ("videos/{}.mp4", "{}.mp4")


def load_dataset(
    path: Path,
    options: ImageOptions = FULL_SIZE,
    files: Mapping[str, str] | None = None,
    require_poses: bool = True,
    horizontal_fov_deg: float | None = None,
) -> Dataset:
    """Every frame of the videos of a calibration JSON, or of the only one in a folder; cameras without a video are
    left out.

    files: camera to video file, relative to the JSON, for videos that are not at ``_PLACES``.
    require_poses: False gives NaN as the pose of a camera that has none in the JSON.
    horizontal_fov_deg: lens of a video that ``path`` is itself, without distortion.
    Raises DatasetError.
    """
    if path.is_file() and path.suffix.lower() != ".json":
        if horizontal_fov_deg is None:
            raise DatasetError(f"{path}: its lens is not known: give horizontal_fov_deg, or a calibration JSON as data")
        clip = Clip(path)
        alone = CalibratedCamera(Pinhole.from_fov(clip.width, clip.height, horizontal_fov_deg), None)
        return rig_dataset({path.stem: (alone, clip)}, path, options, require_poses)
    calibration = path if path.is_file() else _find_calibration(path)
    cameras, files = load_calibration(calibration), files or {}
    for name in files:
        if name not in cameras:
            raise DatasetError(f"{calibration}: has no camera {name!r}, for which a video is named")
    found: dict[str, Path] = {}
    for name in cameras:
        if name in files:
            found[name] = calibration.parent / files[name]
            if not found[name].is_file():
                raise DatasetError(f"{found[name]}: no such video (camera {name}), relative to {calibration.name}")
            continue
        with errors_at(str(calibration)):
            places = (file_within(calibration.parent, place.format(name)) for place in _PLACES)
            video = next((file for file in places if file is not None), None)
        if video is not None:
            found[name] = video
    if not found:
        raise DatasetError(f"{calibration}: none of its cameras has a video at {' or '.join(_PLACES)}")
    return rig_dataset({name: (cameras[name], Clip(found[name])) for name in found}, path, options, require_poses)


def rig_dataset(
    rig: Mapping[str, tuple[CalibratedCamera, Clip]], path: Path, options: ImageOptions, require_poses: bool = True
) -> Dataset:
    """Every frame of every video as an image that is read on demand, one camera after the other.

    Times are the videos' own, from the earliest frame of all on: rates may differ, and frames may be missing.
    path: for error messages. require_poses: as in ``load_dataset``.
    Raises DatasetError if a pose is missing, or a video has another size than its calibration.
    """
    rates = {rate(clip.fps) for _, clip in rig.values()}
    first_s = min(float(clip.times_s[0]) for _, clip in rig.values())
    images: list[PosedImage] = []
    for name, (camera, clip) in rig.items():
        lens = camera.intrinsics
        if (clip.height, clip.width) == (lens.width, lens.height) != (clip.width, clip.height):
            clip = clip.as_stored()
        if (clip.width, clip.height) != (lens.width, lens.height):
            raise DatasetError(
                f"{clip.path}: video is {clip.width} x {clip.height}, calibrated for {lens.width} x {lens.height}"
            )
        if camera.pose is None and require_poses:
            raise DatasetError(f"{path}: {name}: R_world_to_cam is missing")
        small = shrink(lens, options.scale)
        matrix = np.full((4, 4), np.nan) if camera.pose is None else camera.pose.matrix()
        for index, time_s in enumerate(clip.times_s):
            images.append(
                PosedImage(
                    name=f"{name}/{index:04d}",
                    camera=name,
                    time_s=float(time_s) - first_s,
                    camera_to_world=matrix,
                    intrinsics=small,
                    read=partial(clip.frame, index, small.width, small.height),
                    release=clip.close,
                )
            )
    return Dataset(tuple(images), 0, float(rates.pop()) if len(rates) == 1 else None)


def _find_calibration(folder: Path) -> Path:
    if not folder.is_dir():
        raise DatasetError(f"{folder}: no such file or folder")
    found = find_files(folder, FILES[:1]) or find_files(folder, FILES[1:])
    if len(found) != 1:
        names = ", ".join(p.name for p in found) or "none"
        raise DatasetError(f"{folder}: expected one {' or '.join(FILES)}, found {names}; name the file itself")
    return found[0]


class Clip:
    """Frames 0 to count - 1 of a video file, which is decoded forwards. Its decoder opens with the first frame.

    Attributes: count; times_s, each frame's own stamp; fps, the usual rate (``VIDEO_FPS`` if the file does not tell);
    even, whether the stamps keep to it; width and height of the frames.
    rotated: as the file's rotation tag says; otherwise as stored.
    Raises DatasetError if the file cannot be opened, or has no frames.
    """

    def __init__(self, path: Path, rotated: bool = True) -> None:
        self.path = path
        self._rotated = rotated
        capture = self._open()
        self.fps = float(capture.get(cv2.CAP_PROP_FPS)) or tuned.VIDEO_FPS
        self.width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self._tag = int(capture.get(cv2.CAP_PROP_ORIENTATION_META))
        self.count = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        self._from_first_ms, first_s = _stamps(path, self.fps)
        # Of a container that does not stamp each frame (MPEG-PS), OpenCV's number of frames is a guess.
        self.count = len(self._from_first_ms) or self.count
        self._stamped = len(self._from_first_ms) > 1 and bool((np.diff(self._from_first_ms) > 0).all())
        if not self._stamped:
            self._from_first_ms = 1e3 / self.fps * np.arange(self.count, dtype=np.float64)
        if self.count < 1:
            raise DatasetError(f"{path}: the video says it has no frames")
        nominal_ms = np.arange(self.count) * (1e3 / self.fps)
        self.even = float(np.abs(self._from_first_ms - nominal_ms).max()) < tuned.EVEN_PERIODS * 1e3 / self.fps
        if not self.even:
            # The mean without gaps: the median of stamps in whole milliseconds is off by up to half of one.
            apart_ms = np.diff(self._from_first_ms)
            usual_ms = np.median(apart_ms)
            self.fps = 1e3 / float(apart_ms[np.abs(apart_ms - usual_ms) <= tuned.SAME_PERIOD * usual_ms].mean())
        self.times_s = first_s + self._from_first_ms / 1e3
        self._capture: cv2.VideoCapture | None = None
        self._next, self._last = 0, -1
        self._block: dict[int, Image] = {}

    def as_stored(self) -> Clip:
        """The same video without the rotation that its tag asks for; itself if it asks for none by a quarter."""
        return Clip(self.path, rotated=False) if self._tag % 180 else self

    def frame(self, index: int, width: int, height: int) -> Image:
        """Frame ``index`` as uint8 RGB, area-averaged to (height, width, 3). Raises DatasetError if there is
        no such frame, or it cannot be decoded."""
        if not 0 <= index < self.count:
            raise DatasetError(f"{self.path}: frame {index} is not within 0..{self.count - 1}")
        backwards, self._last = 0 < self._last - index <= tuned.BLOCK_FRAMES, index
        found = self._block.get(index)
        if found is None or found.shape[:2] != (height, width):
            first = max(0, index - tuned.BLOCK_FRAMES + 1) if backwards else index
            self._block = {k: self._decode(k, width, height) for k in range(first, index + 1)}
        return self._block[index]

    def close(self) -> None:
        """Free the decoder; ``frame`` opens it again."""
        if self._capture is not None:
            self._capture.release()
        self._capture, self._next = None, 0
        self._block.clear()

    def _decode(self, index: int, width: int, height: int) -> Image:
        if self._capture is None:
            self._capture = self._open()
        if not self._next <= index <= self._next + tuned.SKIP_FRAMES:
            found = self._stamped
            if found:
                # OpenCV seeks by the mean rate: where that led, the stamp of the next frame tells.
                self._capture.set(cv2.CAP_PROP_POS_FRAMES, max(0, index - (1 if self.even else tuned.SKIP_FRAMES)))
                found = self._capture.grab()
                stamp_ms = self._capture.get(cv2.CAP_PROP_POS_MSEC)
                self._next = int(np.abs(self._from_first_ms - stamp_ms).argmin()) + 1
            if self._next > index or (
                self._stamped and not found
            ):  # too far, or back, without an index: decode forward
                self._capture.release()
                self._capture, self._next = self._open(), 0
        while self._next < index and self._capture.grab():
            self._next += 1
        ok, image = self._capture.read() if self._next == index else (False, None)
        if not ok or image is None:
            self.close()  # its position is unknown now
            raise DatasetError(f"{self.path}: frame {index} of {self.count} cannot be decoded")
        self._next += 1
        return resize(as_image(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)), width, height)

    def _open(self) -> cv2.VideoCapture:
        if not self.path.is_file():
            raise DatasetError(f"{self.path}: no such video")
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise DatasetError(f"{self.path}: OpenCV cannot open it as a video")
        capture.set(cv2.CAP_PROP_ORIENTATION_AUTO, int(self._rotated))
        return capture


def _stamps(path: Path, fps: float) -> tuple[NDArray[np.float64], float]:
    """The frames' stamps from the first on, ms, and that of the first, s. They are those of the packets, which are not
    decoded, unless some are no frames: a cut without encoding keeps packets from the key frame before it on."""
    stamps = sorted(_grabbed(cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_FORMAT, -1])))
    if len(stamps) > 1:
        late_ms = 0.5 * (stamps[-1][0] + stamps[-2][0])
        if not any(_last_ms(path, max(0, len(stamps) - back)) > late_ms for back in tuned.ENDING_FRAMES):
            stamps = sorted(_grabbed(cv2.VideoCapture(str(path)))) or stamps
    return np.array([ms for ms, _ in stamps]), stamps[0][1] / fps if stamps else 0.0


def _last_ms(path: Path, index: int) -> float:
    """The stamp of the last frame that can be decoded, about from frame ``index`` on; -inf if there is none."""
    capture = cv2.VideoCapture(str(path))
    capture.set(cv2.CAP_PROP_POS_FRAMES, index)
    return max((ms for ms, _ in _grabbed(capture)), default=-np.inf)


def _grabbed(capture: cv2.VideoCapture) -> list[tuple[float, float]]:
    """The stamps of what is left of a video: ms from the first on, and ticks of its rate. It is released then."""
    stamps: list[tuple[float, float]] = []
    while capture.grab():
        stamps.append((capture.get(cv2.CAP_PROP_POS_MSEC), capture.get(cv2.CAP_PROP_PTS)))
    capture.release()
    return stamps
