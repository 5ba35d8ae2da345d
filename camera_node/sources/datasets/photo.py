"""An image file of a data set, which is checked, undistorted, masked and shrunk when it is read."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.sources.datasets.image_reading import composite, image_size, read_image, resize, shrink
from camera_node.sources.datasets.lens import Lens, exact, pinhole, undistort
from camera_node.sources.datasets.records import (
    Dataset,
    DatasetError,
    Image,
    PosedImage,
    errors_at,
    file_within,
    missing_note,
)
from camera_node.sources.source_constants import SAME_SHAPE
from freshfield.depth import DepthImage
from freshfield.geometry import Pose


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
    """An image file.

    lens: of the image as ``read`` finds it before it is undistorted and shrunk.
    mask: image file that is zero in the background.
    ignored: image file of pixels that must not be learned from, and whether these are its zeros or the others.
    upright: rotate the file as its EXIF data say.
    depth: reads the depth that belongs to the photo.
    """

    path: Path
    lens: Lens
    options: ImageOptions
    mask: Path | None = None
    ignored: tuple[Path, bool] | None = None
    upright: bool = False
    depth: Callable[[Photo], DepthImage] | None = None

    def read(self) -> Image:
        """Read it as uint8 RGB or RGBA according to ``options``. Raises DatasetError."""
        image = undistort(self.lens, self._checked(self.path, self.upright))
        if self.mask is not None:
            image = np.dstack([image[..., :3], undistort(self.lens, self._labeled(self.mask))])
        small = shrink(pinhole(self.lens), self.options.scale)
        return resize(composite(image, self.options.background), small.width, small.height)

    def weight(self) -> NDArray[np.float32]:
        """How much each pixel of ``read`` may be learned from, (H, W) in [0, 1]. Raises DatasetError."""
        assert self.ignored is not None
        path, zeros = self.ignored
        kept = self._labeled(path)
        small = shrink(pinhole(self.lens), self.options.scale)
        kept = undistort(self.lens, kept if zeros else 255 - kept)
        shrunk = cv2.resize(kept, (small.width, small.height), interpolation=cv2.INTER_AREA)
        return shrunk.astype(np.float32) / 255.0

    def _labeled(self, path: Path) -> Image:
        """255 where the image of labels at ``path`` is not zero, else 0; (H, W)."""
        return np.where(self._checked(path)[..., :3].any(axis=-1), 255, 0).astype(np.uint8)

    def _checked(self, path: Path, upright: bool = False) -> Image:
        image = read_image(path, upright)
        if image.shape[:2] != (self.lens.height, self.lens.width):
            raise DatasetError(
                f"{path}: image is {image.shape[1]} x {image.shape[0]}, its camera "
                f"{self.lens.width} x {self.lens.height}"
            )
        return image


def fitted(photo: Photo) -> Photo:
    """The photo with the lens of its file's size. The camera's size decides how the file is taken: its pixels as
    stored, possibly of a smaller copy; else as its EXIF data rotate them. Raises DatasetError for another shape."""
    lens, stored = photo.lens, image_size(photo.path)
    if _same_shape(lens, stored):
        return replace(photo, lens=lens.resized(*stored))
    if _same_shape(lens, stored[::-1]) and read_image(photo.path, upright=True).shape[1::-1] == stored[::-1]:
        return replace(photo, lens=lens.resized(*stored[::-1]), upright=True)
    raise DatasetError(
        f"its camera has {lens.width} x {lens.height} pixels, {photo.path.name} {stored[0]} x {stored[1]}: another "
        "shape; was it cropped or rotated after its camera was calibrated?"
    )


def _same_shape(lens: Lens, size: tuple[int, int]) -> bool:
    return abs((size[0] / lens.width) / (size[1] / lens.height) - 1.0) <= SAME_SHAPE


class NoImages(DatasetError):
    """A data set of which no image exists."""


class ImageFiles:
    """The images that a data set lists: those that have a file, and the names of the others.

    folder: of the files. options: how they are read. where: what lists them, for error messages.
    """

    def __init__(self, folder: Path, options: ImageOptions, where: str) -> None:
        self._folder, self._options, self._where = folder, options, where
        self._found: list[PosedImage] = []
        self._missing: list[str] = []

    def path(self, file: str, where: str, endings: Sequence[str] = ("",)) -> Path | None:
        """The file below the folder, with the first of ``endings`` that exists; None: it is missing, which is noted.
        where: beginning of error messages. Raises DatasetError as ``file_within``."""
        with errors_at(where):
            found = file_within(self._folder, file, endings)
        if found is None:
            self._missing.append(file + endings[0])
        return found

    def add(
        self,
        name: str,
        file: str | Path,
        lens: Lens,
        camera_to_world: np.ndarray,
        where: str,
        *,
        endings: Sequence[str] = ("",),
        camera: str = "",
        time_s: float | None = None,
        **more: Any,
    ) -> None:
        """Add an entry.

        name, camera, time_s: as in ``PosedImage``. camera_to_world: (4, 4) or (3, 4), OpenCV axes.
        file: its path, or what ``path`` finds. lens: may be that of a larger original (``fitted``). more: further keys
            of ``Photo``.
        where: beginning of error messages. Raises DatasetError for an impossible pose or lens, or a file that does not
            fit.
        """
        path = file if isinstance(file, Path) else self.path(file, where, endings)
        if path is None:
            return
        with errors_at(where):
            photo = fitted(Photo(path, lens, self._options, **more))
            pose = Pose.from_matrix(camera_to_world).matrix()
            undistorted = pinhole(photo.lens)
        stored = photo.options.scale == 1 and photo.mask is None and not photo.upright and exact(photo.lens)
        self._found.append(
            PosedImage(
                name=name,
                camera=camera,
                time_s=time_s,
                camera_to_world=pose,
                intrinsics=shrink(undistorted, photo.options.scale),
                read=photo.read,
                path=path if stored else None,
                weight=photo.weight if photo.ignored is not None else None,
                depth=None if photo.depth is None else partial(photo.depth, photo),
            )
        )

    def dataset(
        self,
        fps: float | None = None,
        notes: Sequence[str] = (),
        held_out: Iterable[str] = (),
        per_camera: bool = False,
    ) -> Dataset:
        """The images that have a file, with a note on the others; see ``Dataset``. held_out: may name others, too.
        Raises NoImages if no image has a file, DatasetError if two have the same name."""
        count = len(self._found) + len(self._missing)
        notes = [*([missing_note(self._missing, count, self._folder)] if self._missing else []), *notes]
        if not self._found:
            raise NoImages(f"{self._where}: none of its images exists: {'; '.join(notes) or 'it lists none'}")
        with errors_at(self._where):
            kept = frozenset(held_out) & {image.name for image in self._found}
            return Dataset(tuple(self._found), len(self._missing), fps, kept, per_camera, notes=tuple(notes))
