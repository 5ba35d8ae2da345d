"""Writes pictures: those of an export, and rendered ones as an image or a video."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.export import ExportError
from edge_server.export.export_constants import JPEG_QUALITY, RENDERED_FPS
from edge_server.fidelity.images import to_bytes
from edge_server.fields import View

Image = NDArray[np.uint8]
IMAGE_ENDINGS, VIDEO_ENDINGS = (".png", ".jpg", ".jpeg"), (".mp4",)
# OpenCV's own 95 halves the colors' resolution visibly at edges; what is learned from should not.
_JPEG = (cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444)


def write_images(folder: Path, shots: Iterable[View]) -> None:
    """Write every shot (see ``Exporter``) under its name, with transparency where it has some.
    ExportError: a file cannot be written."""
    folder.mkdir(parents=True, exist_ok=True)
    for shot in shots:
        code = cv2.COLOR_RGBA2BGRA if shot.image.shape[2] == 4 else cv2.COLOR_RGB2BGR
        file = folder / shot.camera
        options = () if file.suffix.lower() == ".png" else _JPEG
        if not cv2.imwrite(str(file), cv2.cvtColor(shot.image, code), options):
            raise ExportError(f"{file}: cannot be written")


def write_video(
    file: Path | str, images: Iterable[NDArray[np.uint8] | NDArray[np.float32]], fps: float = RENDERED_FPS
) -> tuple[int, int, int]:
    """Write a video, or the first image where the file is one. The file is replaced once all of it is there.

    file: ends in .mp4, or in .png or .jpg.
    images: RGB (height, width, 3), uint8 or float in [0, 1], all of one size, which is even in a video.
    fps: images a second.
    Returns the number of images, and their width and height. Raises ExportError: another ending or size, no image, or
    a file that cannot be written.
    """
    file = checked_file(Path(file))
    part = file.with_name(f".{file.stem}.part{file.suffix}")
    video: cv2.VideoWriter | None = None
    count, size = 0, (0, 0)
    try:
        for image in images:
            bgr = np.ascontiguousarray(to_bytes(image)[..., ::-1])
            size = size if count else (bgr.shape[1], bgr.shape[0])
            if size != (bgr.shape[1], bgr.shape[0]):
                raise ExportError(f"{file}: image {count} has another size than the first")
            count += 1
            if file.suffix.lower() in IMAGE_ENDINGS:
                if not cv2.imwrite(str(part), bgr):
                    raise ExportError(f"{file}: cannot be written")
                break
            video = video or _opened(file, part, fps, size)
            video.write(bgr)
        if not count:
            raise ExportError(f"{file}: no image to write")
        if video is not None:
            video.release()
            _check_complete(file, part, count)
        part.replace(file)
    finally:
        if video is not None:
            video.release()
        part.unlink(missing_ok=True)
    return count, *size


def _check_complete(file: Path, part: Path, count: int) -> None:
    """ExportError unless the video ``part`` has ``count`` images: OpenCV does not tell that it could not write some."""
    written = cv2.VideoCapture(str(part))
    try:
        if not written.isOpened() or int(written.get(cv2.CAP_PROP_FRAME_COUNT)) != count:
            raise ExportError(f"{file}: cannot be written whole: is the disk full?")
    finally:
        written.release()


def checked_file(file: Path) -> Path:
    """ExportError unless ``write_video`` can write such a file."""
    if file.suffix.lower() not in (*IMAGE_ENDINGS, *VIDEO_ENDINGS):
        raise ExportError(f"{file}: expected a file that ends in {', '.join((*IMAGE_ENDINGS, *VIDEO_ENDINGS))}")
    return file


def _opened(file: Path, part: Path, fps: float, size: tuple[int, int]) -> cv2.VideoWriter:
    if size[0] % 2 or size[1] % 2:
        raise ExportError(f"{file}: videos need even sizes, not {size[0]} x {size[1]}: give --size")
    video = cv2.VideoWriter(str(part), cv2.VideoWriter.fourcc(*"mp4v"), fps, size)
    if not video.isOpened():
        raise ExportError(f"{file}: cannot be written: is the folder there, and has OpenCV its video codecs?")
    return video
