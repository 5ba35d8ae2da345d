"""An image file of a data set, which is checked, undistorted, masked and shrunk when it is read."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_node.sources.datasets.imaging import composite, read_image, resize, shrink
from camera_node.sources.datasets.lens import Lens, exact, pinhole, undistort
from camera_node.sources.datasets.records import DatasetError, Image, PosedImage, errors_at
from freshfield.geometry import Pose

# Tolerated difference of aspect ratio between an image and its original, due to rounding to whole pixels.
_SAME_SHAPE = 0.02


@dataclass(frozen=True)
class ImageOptions:
    """How a data set's images are read.

    scale: image sizes are divided by it, at least 1.
    background: ``white`` or ``black`` behind transparent pixels; ``keep`` keeps alpha.
    """

    scale: float = 1.0
    background: str = "keep"


FULL_SIZE = ImageOptions()


@dataclass(frozen=True)
class Photo:
    """An image file. lens: of the file as stored. mask: image file that is zero in the background."""

    path: Path
    lens: Lens
    options: ImageOptions
    mask: Path | None = None

    def read(self) -> Image:
        """Read it as uint8 RGB or RGBA according to ``options``. Raises DatasetError."""
        image = undistort(self.lens, self._checked(self.path))
        if self.mask is not None:
            # Masks hold labels or 255: every nonzero pixel is kept.
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
    """The lens scaled to the size of the image at ``path``, which may be a smaller copy.

    where: beginning of error messages. Raises DatasetError for another aspect ratio, or an unreadable image.
    """
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
    photo: Photo, name: str, camera_to_world: np.ndarray, where: str, camera: str = "", time_s: float | None = None
) -> PosedImage:
    """A photo with its pose, as a data set's image.

    name, camera, time_s: as in ``PosedImage``. camera_to_world: (4, 4) or (3, 4), OpenCV axes.
    where: beginning of error messages. Raises DatasetError for an impossible pose or lens.
    """
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
        # The stored file can be sent as it is if it is not scaled, masked or undistorted.
        path=photo.path if photo.options.scale == 1 and photo.mask is None and exact(photo.lens) else None,
    )
