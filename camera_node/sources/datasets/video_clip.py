"""Random access to the frames of a video file, which is decoded forwards, one frame at a time."""

from __future__ import annotations

from pathlib import Path

from camera_node.sources.datasets.imaging import as_image, resize
from camera_node.sources.datasets.records import DatasetError, Image
from freshfield import payload  # noqa: F401  (sets OpenCV's size limit before cv2 is imported)

import cv2  # isort: skip

# Up to this distance, decoding forward is cheaper than seeking, which decodes from a key frame.
_SKIP_FRAMES = 30


class Clip:
    """Frames 0 to count - 1 of a video file. Holds one decoder and no frames.

    Attributes: count, fps (30 if the file does not tell), width and height as stored.
    Raises DatasetError if the file cannot be opened, or has no frames.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._capture = self._open()
        self.fps = float(self._capture.get(cv2.CAP_PROP_FPS)) or 30.0
        self.width = int(self._capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        self.height = int(self._capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        self.count = int(self._capture.get(cv2.CAP_PROP_FRAME_COUNT))
        if self.count < 1:
            raise DatasetError(f"{path}: the video says it has no frames")
        self._next = 0

    def frame(self, index: int, width: int, height: int) -> Image:
        """Frame ``index`` as uint8 RGB, area-averaged to (height, width, 3). Raises DatasetError if there is
        no such frame, or it cannot be decoded."""
        if not 0 <= index < self.count:
            raise DatasetError(f"{self.path}: frame {index} is not within 0..{self.count - 1}")
        if not self._next <= index <= self._next + _SKIP_FRAMES:
            self._seek(index)
        while self._next < index:
            if not self._capture.grab():
                raise self._damaged(index)
            self._next += 1
        ok, image = self._capture.read()
        if not ok:
            raise self._damaged(index)
        self._next += 1
        return resize(as_image(cv2.cvtColor(image, cv2.COLOR_BGR2RGB)), width, height)

    def close(self) -> None:
        self._capture.release()

    def _open(self) -> cv2.VideoCapture:
        if not self.path.is_file():
            raise DatasetError(f"{self.path}: no such video")
        capture = cv2.VideoCapture(str(self.path))
        if not capture.isOpened():
            raise DatasetError(f"{self.path}: OpenCV cannot open it as a video")
        return capture

    def _seek(self, index: int) -> None:
        self._capture.set(cv2.CAP_PROP_POS_FRAMES, index)
        self._next = int(self._capture.get(cv2.CAP_PROP_POS_FRAMES))
        if self._next > index:  # a container without an index: start again and decode forward
            self._capture.release()
            self._capture = self._open()
            self._next = 0

    def _damaged(self, index: int) -> DatasetError:
        # The decoder's position is unknown now: make the next call seek.
        self._next = self.count
        return DatasetError(f"{self.path}: frame {index} of {self.count} cannot be decoded")
