"""Calibration targets by name, and a target's pose from one image.

    charuco:7x5:30mm:22mm[:4X4_50]     squares across x down, their side, the markers' side, dictionary; also as
                                       OpenCV before 4.6 and calib.io print it, a white square first
    chessboard:9x6:23.6mm              inner corners across x down, side of a square

Target axes: origin at the top left corner of the printed pattern (of a chessboard: the first inner corner),
x to the right, y down, z away from the viewer, meters.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration import calibration_constants as tuned
from freshfield.geometry import Array, Pinhole, se3

GrayImage = NDArray[np.uint8]

NOTATIONS = "charuco:7x5:30mm:22mm or chessboard:9x6:23.6mm"
WHICH_PRINT = "parts of the board fit two prints, a square apart: show all of it once"
# The largest dictionaries: each holds the smaller ones of its kind.
_DICTIONARIES = (
    *(f"{n}X{n}_1000" for n in (4, 5, 6, 7)),
    *(f"APRILTAG_{name}" for name in ("16H5", "25H9", "36H10", "36H11")),
    "ARUCO_ORIGINAL",
    "ARUCO_MIP_36H12",
)
_SIZES = (50, 100, 250, 1000)
# Corners of a chessboard that was described by its squares, or miscounted by one or two.
_OTHER_SIZES = ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1), (-2, -2), (2, 2))
_CHESSBOARD = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
_SUBPIX = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, tuned.SUBPIX_STEPS, tuned.SUBPIX_PX)


@dataclass(frozen=True)
class Corners:
    """Corners of a target. pixels: (N, 2), in this project's corner origin. points: (N, 3) in the target's
    axes."""

    pixels: Array
    points: Array


class Target(ABC):
    """A calibration target.

    name: its SPEC. square_m: side of a square.
    size_m: width and height of the drawing, whose width has so many ``modules``. pattern_m: without its white border.
    """

    name: str
    square_m: float
    size_m: tuple[float, float]
    modules: int
    pattern_m: tuple[float, float]

    @abstractmethod
    def find(self, image: GrayImage) -> Corners | None:
        """The corners in an image."""

    @abstractmethod
    def explain(self, image: GrayImage) -> str:
        """Why they are not found in an image, as far as it tells; "" if it does not."""

    @abstractmethod
    def draw(self, width: int) -> GrayImage:
        """A drawing of a width in pixels, exact at multiples of ``modules``."""

    def decided(self) -> bool:
        """Whether it is known which of two prints it is, see ``Charuco``."""
        return True


def parse_target(spec: str) -> Target:
    """The target of a SPEC (see above). Raises CalibrationError."""
    kind, *rest = spec.split(":")
    try:
        if kind not in _KINDS:
            raise ValueError(f"no kind {kind!r}")
        return _KINDS[kind](spec, *rest)
    except (TypeError, ValueError) as error:
        why = f" ({error})" if isinstance(error, ValueError) else ""
        raise CalibrationError(f"target {spec!r}: expected for example {NOTATIONS}{why}") from None


def draw_for_print(target: Target, dpi: float) -> GrayImage:
    """A target in its size at ``dpi``, with the white border that detectors need. Raises CalibrationError."""
    sides = [side_m / 0.0254 * dpi for side_m in target.size_m]
    if not 64 <= sides[0] <= 32_000:
        raise CalibrationError(f"--dpi: makes a picture {sides[0]:.0f} pixels wide, expected 64 to 32000")
    width, height = map(round, sides)
    # Draw finer, with whole pixels per module, then scale. Otherwise the modules' rounding errors add up.
    fine = target.draw(target.modules * math.ceil(2 * width / target.modules))
    image = cv2.resize(fine, (width, height), interpolation=cv2.INTER_AREA)
    return np.pad(image, max(8, width // 10), constant_values=255)


def estimate_pose(corners: Corners, lens: Pinhole) -> Array:
    """Pose (4, 4) of a flat target in the camera from its corners. Raises CalibrationError if none is found or two
    are equally likely (a small target seen straight on)."""
    matrix, distortion = lens.opencv()
    # OpenCV's origin is the center of the first pixel.
    pixels = np.ascontiguousarray(corners.pixels - 0.5)
    count, turns, shifts, errors = cv2.solvePnPGeneric(
        corners.points, pixels, matrix, distortion, flags=cv2.SOLVEPNP_IPPE
    )
    if not count or not np.isfinite(turns[0]).all() or shifts[0][2] <= 0:
        raise CalibrationError("the target's pose cannot be found from its corners")
    errors = np.ravel(errors)
    if (
        count > 1
        and len(corners.points) < tuned.AMBIGUOUS_CORNERS
        and errors[1] < tuned.AMBIGUOUS * max(float(errors[0]), tuned.AMBIGUOUS_PX)
    ):
        raise CalibrationError("the target is seen so straight on that it may be tilted either way")
    turn, shift = cv2.solvePnPRefineLM(corners.points, pixels, matrix, distortion, turns[0], shifts[0])
    return se3(cv2.Rodrigues(turn)[0], shift.ravel())


def to_gray(image: NDArray[np.uint8]) -> GrayImage:
    """Gray (H, W) of a gray, RGB or RGBA image."""
    if image.ndim == 2:
        return image
    code = cv2.COLOR_RGBA2GRAY if image.shape[2] == 4 else cv2.COLOR_RGB2GRAY
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


class Charuco(Target):
    """A ChArUco board, in OpenCV's print or in the one before 4.6, which differs where the number of rows is even.

    A part of a board can fit both prints, a square apart: which one it is, the pictures in which only one of them finds
    corners tell.
    """

    def __init__(self, name: str, squares: str, square: str, marker: str, dictionary: str = "4X4_50") -> None:
        across, down = self._counts = _counts(squares)
        self.name, self.modules, self.square_m = name, across, _meters(square)
        self.size_m = self.pattern_m = (across * self.square_m, down * self.square_m)
        self._marker, self._dictionary = _meters(marker) / self.square_m, dictionary.upper()
        if not self._marker < 1.0:
            raise ValueError("the markers must be smaller than the squares")
        needed, held = across * down // 2, len(_dictionary(self._dictionary).bytesList)
        if needed > held:
            raise ValueError(f"it has {needed} markers, {self._dictionary} {held}: add a larger one, such as :4X4_1000")
        self._detectors = _charuco_detectors(across, down, self._marker, self._dictionary)
        self._board = self._detectors[0].getBoard()
        self._places = self.square_m * np.asarray(self._board.getChessboardCorners(), dtype=np.float64)
        self._total = [0] * len(self._detectors)  # corners by print, of pictures that tell the prints apart

    def find(self, image: GrayImage) -> Corners | None:
        prints = _detect(self._detectors, image)
        counts = [len(numbers) for _, numbers in prints]
        if max(counts) - min(counts) >= tuned.MIN_CORNERS:
            self._total = [count + before for count, before in zip(counts, self._total)]
        pixels, numbers = prints[int(np.argmax(self._total if any(self._total) else counts))]
        if len(numbers) < tuned.MIN_CORNERS:
            return None
        points = self._places[numbers]
        if min(len(np.unique(points[:, axis].round(6))) for axis in (0, 1)) < 2:
            return None  # all on one line
        return Corners(pixels + 0.5, points)

    def decided(self) -> bool:
        return any(self._total) or len(self._detectors) == 1

    def draw(self, width: int) -> GrayImage:
        across, down = self._counts
        return np.asarray(self._board.generateImage((width, round(width * down / across))), dtype=np.uint8)

    def explain(self, image: GrayImage) -> str:
        numbers = _markers(image, self._dictionary)
        if len(numbers) < tuned.MIN_MARKERS:
            return self._other_markers(image)
        across, down = self._counts
        for other in _other_boards(across, down, int(numbers.max())):
            found = _detect(_charuco_detectors(*other, self._marker, self._dictionary), image)
            if max(len(corners) for _, corners in found) >= tuned.MIN_CORNERS:
                what = "its sizes are swapped" if other == (down, across) else "it is a board of another size"
                return f"{what}: {other[0]}x{other[1]} squares, not {across}x{down}"
        return f"{len(numbers)} markers are seen, but not arranged like this board's"

    def _other_markers(self, image: GrayImage) -> str:
        """What is seen instead of this board's markers."""
        if len(_markers(np.ascontiguousarray(image[:, ::-1]), self._dictionary)) >= tuned.MIN_MARKERS:
            return "the picture is mirrored: switch that off in the camera's settings"
        seen = {name: _markers(image, name) for name in _DICTIONARIES}
        name = max(seen, key=lambda each: len(seen[each]))
        if len(seen[name]) < tuned.MIN_MARKERS:
            return "no markers are seen: is the board small, blurred, dark, or another one?"
        kind, _, largest = name.rpartition("_")
        if largest.isdigit():
            name = f"{kind}_{next(size for size in _SIZES if seen[name].max() < size)}"
        return f"its markers are of dictionary {name}, not {self._dictionary}"


@lru_cache(maxsize=8)
def _charuco_detectors(across: int, down: int, marker: float, dictionary: str) -> tuple[cv2.aruco.CharucoDetector, ...]:
    """Of both prints that a board has, or of its one, with squares of side 1."""
    found = []
    for legacy in (False, True)[: 1 + (down % 2 == 0)]:
        board = cv2.aruco.CharucoBoard((across, down), 1.0, marker, _dictionary(dictionary))
        board.setLegacyPattern(legacy)
        found.append(cv2.aruco.CharucoDetector(board))
    return tuple(found)


def _detect(detectors: Sequence[cv2.aruco.CharucoDetector], image: GrayImage) -> list[tuple[Array, NDArray[np.intp]]]:
    """Corners (N, 2), pixel centers at whole numbers, and their numbers (N,) on the board, by print."""
    found = []
    for detector in detectors:
        pixels, numbers, _, _ = detector.detectBoard(image)
        seen = numbers is not None and len(numbers) > 0
        at = np.asarray(pixels if seen else [], np.float64).reshape(-1, 2)
        found.append((at, np.asarray(numbers if seen else [], np.intp).ravel()))
    return found


def _markers(image: GrayImage, dictionary: str) -> NDArray[np.intp]:
    """Numbers (N,) of the markers that are seen."""
    _, numbers, _ = cv2.aruco.ArucoDetector(_dictionary(dictionary)).detectMarkers(image)
    return np.zeros(0, np.intp) if numbers is None else numbers.ravel().astype(np.intp)


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    if not hasattr(cv2.aruco, f"DICT_{name}"):
        raise ValueError(f"no dictionary {name}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{name}"))


def _other_boards(across: int, down: int, highest: int) -> list[tuple[int, int]]:
    """Boards that have a marker of number ``highest`` and few beyond it: the one with swapped sizes first."""
    sides = range(3, tuned.MOST_SQUARES + 1)
    fitting = [
        (a, d)
        for a in sides
        for d in sides
        if highest < a * d // 2 <= highest + tuned.UNSEEN_MARKERS and (a, d) != (across, down)
    ]
    return list(dict.fromkeys([(down, across), *fitting]))


class Chessboard(Target):
    """A chessboard, by its inner corners."""

    def __init__(self, name: str, corners: str, square: str) -> None:
        across, down = self._counts = _counts(corners)
        self.name, self.modules, self.square_m = name, across + 3, _meters(square)
        if (across + down) % 2 == 0:
            raise ValueError("one of the numbers of corners must be odd and the other even, or up looks as down")
        self.size_m, self.pattern_m = (((across + n) * self.square_m, (down + n) * self.square_m) for n in (3, 1))
        y, x = np.mgrid[0:down, 0:across].reshape(2, -1) * self.square_m
        self._places = np.stack([x, y, np.zeros_like(x)], axis=1)

    def find(self, image: GrayImage) -> Corners | None:
        across, down = self._counts
        found, pixels = cv2.findChessboardCorners(image, (across, down), flags=_CHESSBOARD)
        if not found:
            return None
        pixels = pixels.reshape(down, across, 2)
        # A third of the distance to the nearest neighbor, so that the window holds no other corner.
        steps = [np.linalg.norm(np.diff(pixels, axis=k), axis=2).min() for k in (0, 1)]
        window = int(np.clip(min(steps) / 3, tuned.LEAST_WINDOW_PX, tuned.MOST_WINDOW_PX))
        pixels = cv2.cornerSubPix(image, pixels.reshape(-1, 1, 2), (window, window), (-1, -1), _SUBPIX)
        # The detector begins at the black one of the two end squares, whichever way up the board is.
        return Corners(pixels.reshape(-1, 2).astype(np.float64) + 0.5, self._places)

    def draw(self, width: int) -> GrayImage:
        across, down = self._counts
        # The detector needs white around the outer squares.
        cell = max(1, width // self.modules)
        board = (np.indices((down + 1, across + 1)).sum(axis=0) % 2 * 255).astype(np.uint8)
        return np.pad(np.kron(board, np.ones((cell, cell), np.uint8)), cell, constant_values=255)

    def explain(self, image: GrayImage) -> str:
        across, down = self._counts
        for wider, taller in _OTHER_SIZES:
            size = across + wider, down + taller
            if min(size) >= 3 and cv2.findChessboardCorners(image, size, flags=_CHESSBOARD)[0]:
                return f"a board of {size[0]}x{size[1]} inner corners is seen, not of {across}x{down}"
        return ""


_KINDS = {"charuco": Charuco, "chessboard": Chessboard}


def _counts(text: str) -> tuple[int, int]:
    across, down = (int(part) for part in text.lower().split("x"))
    if not (3 <= across <= 100 and 3 <= down <= 100):
        raise ValueError("sizes from 3x3 to 100x100")
    return across, down


def _meters(text: str) -> float:
    units = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
    unit = next((u for u in units if text.endswith(u)), None)
    if unit is None:
        raise ValueError(f"{text!r} needs a unit: mm, cm or m")
    value = float(text.removesuffix(unit)) * units[unit]
    if not 1e-3 <= value <= 10.0:
        raise ValueError(f"{text!r} is not within 1 mm to 10 m")
    return value
