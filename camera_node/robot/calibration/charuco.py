"""Finds ChArUco boards in images, and says what is wrong with a board that is not found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration.settings import MIN_CORNERS, MIN_MARKERS
from freshfield.geometry import Array

GrayImage = NDArray[np.uint8]

# The largest dictionaries: each holds the smaller ones of its kind.
_DICTIONARIES = (
    *(f"{n}X{n}_1000" for n in (4, 5, 6, 7)),
    *(f"APRILTAG_{name}" for name in ("16H5", "25H9", "36H10", "36H11")),
    "ARUCO_ORIGINAL",
    "ARUCO_MIP_36H12",
)
_SIZES = (50, 100, 250, 1000)
_MOST_SQUARES = 16  # across and down, of boards that are tried


@dataclass(frozen=True)
class CharucoPrint:
    """What is printed: squares across and down, a marker's side in sides of a square, and the dictionary."""

    across: int
    down: int
    marker: float
    dictionary: str


@lru_cache(maxsize=8)
def _detectors(printed: CharucoPrint) -> tuple[cv2.aruco.CharucoDetector, ...]:
    """Of the board as OpenCV prints it, and of the one before 4.6, which differs where the number of rows is even."""
    found = []
    for legacy in (False, True)[: 1 + (printed.down % 2 == 0)]:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{printed.dictionary}"))
        board = cv2.aruco.CharucoBoard((printed.across, printed.down), 1.0, printed.marker, dictionary)
        board.setLegacyPattern(legacy)
        found.append(cv2.aruco.CharucoDetector(board))
    return tuple(found)


Found = tuple[Array, NDArray[np.intp]]


def find_charuco(image: GrayImage, printed: CharucoPrint) -> tuple[Found, ...]:
    """Corners (N, 2), pixel centers at whole numbers, and their numbers (N,) on the board, for each print that there
    is; none where it is not there. A part of a board can fit both prints, a square apart: which one it is, the picture
    in which only one of them finds corners tells."""
    found: list[Found] = []
    for detector in _detectors(printed):
        pixels, numbers, _, _ = detector.detectBoard(image)
        if numbers is None or not len(numbers):
            found.append((np.zeros((0, 2)), np.zeros(0, np.intp)))
        else:
            found.append((pixels.reshape(-1, 2).astype(np.float64), numbers.ravel().astype(np.intp)))
    return tuple(found)


def explain_charuco(image: GrayImage, printed: CharucoPrint) -> str:
    """Why the board is not found, as far as the image tells; "" if it does not."""
    numbers = _markers(image, printed.dictionary)
    if len(numbers) < MIN_MARKERS:
        mirrored = np.ascontiguousarray(image[:, ::-1])
        if len(_markers(mirrored, printed.dictionary)) >= MIN_MARKERS:
            return "the picture is mirrored: switch that off in the camera's settings"
        seen = {name: _markers(image, name) for name in _DICTIONARIES}
        name = max(seen, key=lambda each: len(seen[each]))
        if len(seen[name]) < MIN_MARKERS:
            return "no markers are seen: is the board small, blurred, dark, or another one?"
        kind, _, largest = name.rpartition("_")
        if largest.isdigit():
            name = f"{kind}_{next(size for size in _SIZES if seen[name].max() < size)}"
        return f"its markers are of dictionary {name}, not {printed.dictionary}"
    for other in _other_boards(printed, int(numbers.max())):
        if max(len(numbers) for _, numbers in find_charuco(image, other)) >= MIN_CORNERS:
            swapped = (other.across, other.down) == (printed.down, printed.across)
            what = "its sizes are swapped" if swapped else "it is a board of another size"
            return f"{what}: {other.across}x{other.down} squares, not {printed.across}x{printed.down}"
    return f"{len(numbers)} markers are seen, but not arranged like this board's"


def _markers(image: GrayImage, dictionary: str) -> NDArray[np.intp]:
    """Numbers (N,) of the markers that are seen."""
    known = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{dictionary}"))
    _, numbers, _ = cv2.aruco.ArucoDetector(known).detectMarkers(image)
    return np.zeros(0, np.intp) if numbers is None else numbers.ravel().astype(np.intp)


def _other_boards(printed: CharucoPrint, highest: int) -> list[CharucoPrint]:
    """Boards that have a marker of number ``highest`` and few beyond it: the one with swapped sizes first."""
    sizes = [(printed.down, printed.across)]
    for across in range(3, _MOST_SQUARES + 1):
        for down in range(3, _MOST_SQUARES + 1):
            if highest < across * down // 2 <= highest + 3 and (across, down) != (printed.across, printed.down):
                sizes.append((across, down))
    return [replace(printed, across=across, down=down) for across, down in dict.fromkeys(sizes)]
