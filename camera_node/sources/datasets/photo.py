"""One posed image file of a data set: checked, undistorted, masked and shrunk when it is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_node.sources.datasets.imaging import composite, read_image, resize, shrink
from camera_node.sources.datasets.lens import Lens, exact, pinhole, undistort
from camera_node.sources.datasets.records import DatasetError, Image, PosedImage, errors_at
from freshfield.geometry import Pose

# A smaller copy has its original's shape but for rounding to whole pixels.
_SAME_SHAPE = 0.02


@dataclass(frozen=True)
class ImageOptions:
    """How a data set's images are read. scale: their sizes are divided by it. background: white or black goes
    under transparent pixels; keep leaves alpha."""

    scale: float = 1.0
    background: str = "keep"


FULL_SIZE = ImageOptions()


@dataclass(frozen=True)
class Photo:
    """path: the file, taken with ``lens``. mask: an image that is zero where the background is."""

    path: Path
    lens: Lens
    options: ImageOptions
    mask: Path | None = None

    def read(self) -> Image:
        """uint8 RGB or RGBA, as ``options`` say. Raises DatasetError."""
        image = undistort(self.lens, self._checked(self.path))
        if self.mask is not None:
            # Labels or 255: anything that is not zero is kept.
            kept = np.where(self._checked(self.mask)[..., :3].any(axis=-1), 255, 0).astype(np.uint8)
            image = np.dstack([image[..., :3], undistort(self.lens, kept)])
        small = shrink(pinhole(self.lens), self.options.scale)
        return resize(composite(image, self.options.background), small.width, small.height)

    def _checked(self, path: Path) -> Image:
        image = read_image(path)
        if image.shape[:2] != (self.lens.height, self.lens.width):
            raise DatasetError(
                f"{path}: image is {image.shape[1]} x {image.shape[0]}, its camera "
                f"{self.lens.width} x {self.lens.height}"
            )
        return image


def lens_for_image(lens: Lens, path: Path, where: str) -> Lens:
    """The lens scaled to the size of the image at ``path``: data sets keep smaller copies. where: starts
    messages. Raises DatasetError for another shape."""
    height, width = read_image(path).shape[:2]
    if (width, height) == (lens.width, lens.height):
        return lens
    if abs((width / lens.width) / (height / lens.height) - 1.0) > _SAME_SHAPE:
        raise DatasetError(
            f"{where}: its camera has {lens.width} x {lens.height} pixels, {path.name} {width} x {height}: "
            "another shape"
        )
    return lens.resized(width, height)


def posed_photo(
    photo: Photo,
    name: str,
    camera_to_world: np.ndarray,
    where: str,
    camera: str = "",
    time_s: float | None = None,
) -> PosedImage:
    """A photo with its pose. where: starts messages. Raises DatasetError for an impossible pose or lens."""
    with errors_at(where):
        pose = Pose.from_matrix(camera_to_world).matrix()
        undistorted = pinhole(photo.lens)
    return PosedImage(
        name=name,
        camera=camera,
        time_s=time_s,
        camera_to_world=pose,
        intrinsics=shrink(undistorted, photo.options.scale),
        read=photo.read,
        # Sent as it is stored where it is what would be shown.
        path=photo.path if photo.options.scale == 1 and photo.mask is None and exact(photo.lens) else None,
    )
