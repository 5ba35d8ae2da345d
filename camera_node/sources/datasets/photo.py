"""One posed image file of a data set: checked, straightened, cut out and shrunk when somebody looks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from camera_node.sources.datasets.imaging import composite, read_image, resize, shrink
from camera_node.sources.datasets.lens import Lens, exact, pinhole, straighten
from camera_node.sources.datasets.records import DatasetError, Image, Record
from freshfield.geometry import GeometryError, Pose

# A smaller copy has its original's shape but for rounding to whole pixels.
_SAME_SHAPE = 0.02


@dataclass(frozen=True)
class Look:
    """How a data set's images are wanted. scale: they are divided by it. background: white or black, what
    transparent ones are laid on, or keep."""

    scale: float = 1.0
    background: str = "keep"


@dataclass(frozen=True)
class Photo:
    """path: the file, taken with ``lens``. mask: an image that is zero where the background is."""

    path: Path
    lens: Lens
    look: Look
    mask: Path | None = None

    def read(self) -> Image:
        """RGB or RGBA as wanted. Raises DatasetError."""
        image = straighten(self.lens, self._checked(self.path))
        if self.mask is not None:
            # Labels or 255: anything that is not zero is kept.
            kept = np.where(self._checked(self.mask)[..., :3].any(axis=-1), 255, 0).astype(np.uint8)
            image = np.dstack([image[..., :3], straighten(self.lens, kept)])
        small = shrink(pinhole(self.lens), self.look.scale)
        return resize(composite(image, self.look.background), small.width, small.height)

    def _checked(self, path: Path) -> Image:
        image = read_image(path)
        if image.shape[:2] != (self.lens.height, self.lens.width):
            raise DatasetError(
                f"{path}: image is {image.shape[1]} x {image.shape[0]}, its camera "
                f"{self.lens.width} x {self.lens.height}"
            )
        return image


def fitted(lens: Lens, path: Path, where: str) -> Lens:
    """The lens for images of the size of the one at ``path``: data sets keep smaller copies. where: starts
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


def record_of(
    photo: Photo,
    name: str,
    camera_to_world: np.ndarray,
    where: str,
    camera: str = "",
    time_s: float | None = None,
) -> Record:
    """The record of a photo. where: starts messages. Raises DatasetError for an impossible pose or lens."""
    try:
        pose = Pose.from_matrix(camera_to_world).matrix()
        straight = pinhole(photo.lens)
    except (GeometryError, DatasetError) as error:
        raise DatasetError(f"{where}: {error}") from None
    return Record(
        name=name,
        camera=camera,
        time_s=time_s,
        camera_to_world=pose,
        intrinsics=shrink(straight, photo.look.scale),
        read=photo.read,
        # Sent as it is stored where it is what would be shown.
        path=photo.path if photo.look.scale == 1 and photo.mask is None and exact(photo.lens) else None,
    )
