"""What a recorded data set is made of: posed images that are read when somebody looks at them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from freshfield.geometry import Pinhole

Image = NDArray[np.uint8]


class DatasetError(ValueError):
    """A data set that cannot be used. The message is one line: file, what was wrong, what to do."""


@dataclass(frozen=True)
class Record:
    """One posed image of a data set.

    name: as the data set calls it, unique in it. camera: "" in a set of photos taken by one camera that
    moved. time_s: None where the data set knows no time. camera_to_world: float64 (4, 4), OpenCV axes, in
    the data set's units. intrinsics: of the image as ``read`` returns it. read: uint8 (H, W, 3) RGB, or
    (H, W, 4) straight-alpha RGBA; raises DatasetError for a file that is damaged or of another size. path:
    the image's own file, where it has one and is shown unscaled.
    """

    name: str
    camera: str
    time_s: float | None
    camera_to_world: NDArray[np.float64]
    intrinsics: Pinhole
    read: Callable[[], Image]
    path: Path | None = None


@dataclass(frozen=True)
class Dataset:
    """Records in the data set's own order; ``missing`` counts entries that have no file. held_out: names of
    the records that the data set itself keeps for testing, where it says so."""

    records: tuple[Record, ...]
    missing: int = 0
    fps: float | None = None
    held_out: frozenset[str] = frozenset()

    def __len__(self) -> int:
        return len(self.records)

    def __iter__(self) -> Iterator[Record]:
        return iter(self.records)

    def __getitem__(self, index: int) -> Record:
        return self.records[index]

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras in order of appearance; ("",) for a set of photos."""
        return tuple(dict.fromkeys(r.camera for r in self.records))

    @property
    def moving(self) -> bool:
        """True where cameras and times are known: a recording of something that moves."""
        return any(r.camera and r.time_s is not None for r in self.records)

    def of(self, camera: str) -> tuple[Record, ...]:
        """The records of one camera, in the order of time."""
        found = [r for r in self.records if r.camera == camera]
        return tuple(sorted(found, key=lambda r: 0.0 if r.time_s is None else r.time_s))
