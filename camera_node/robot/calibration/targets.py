"""Calibration targets by name, and a target's pose from one image.

    charuco:7x5:30mm:22mm[:4X4_50]     squares across x down, their side, the markers' side, dictionary; also as
                                       OpenCV before 4.6 and calib.io print it, a white square first
    chessboard:9x6:23.6mm              inner corners across x down, side of a square

Target axes: origin at the top left corner of the printed pattern (of a chessboard: the first inner corner),
x to the right, y down, z away from the viewer, meters.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.charuco import CharucoPrint, GrayImage, explain_charuco, find_charuco
from camera_node.robot.calibration.settings import AMBIGUOUS, MIN_CORNERS
from freshfield.geometry import Array, Pinhole, se3

NOTATIONS = "charuco:7x5:30mm:22mm or chessboard:9x6:23.6mm"
WHICH_PRINT = "parts of the board fit two prints, a square apart: show all of it once"
# Corners of a chessboard that was described by its squares, or miscounted by one or two.
_OTHER_SIZES = ((-1, -1), (1, 1), (-1, 0), (0, -1), (1, 0), (0, 1), (-2, -2), (2, 2))
_SUBPIX = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 40, 1e-4)


@dataclass(frozen=True)
class Corners:
    """Corners of a target. pixels: (N, 2), in this project's corner origin. points: (N, 3) in the target's
    axes."""

    pixels: Array
    points: Array


@dataclass(frozen=True)
class Target:
    """A calibration target.

    name: its SPEC.
    size_m: width and height of the drawing.
    find: returns the corners in a gray image, or None.
    explain: says why they are not found in a gray image, as far as it tells; "" if it does not.
    draw: returns a drawing of a given width in pixels, exact at multiples of ``modules`` (its width in
        modules).
    pattern_m: width and height without the white border.
    square_m: side of a square.
    decided: whether it is known which of two prints the target is (see ``charuco.find_charuco``).
    """

    name: str
    size_m: tuple[float, float]
    find: Callable[[GrayImage], Corners | None]
    explain: Callable[[GrayImage], str]
    draw: Callable[[int], GrayImage]
    modules: int
    pattern_m: tuple[float, float]
    square_m: float
    decided: Callable[[], bool] = lambda: True


def parse_target(spec: str) -> Target:
    """The target of a SPEC (see above). Raises CalibrationError."""
    kind, *rest = spec.split(":")
    try:
        if kind not in _MAKERS:
            raise ValueError(f"no kind {kind!r}")
        return _MAKERS[kind](spec, *rest)
    except (TypeError, ValueError, AttributeError) as error:
        why = f" ({error})" if isinstance(error, ValueError) else ""
        raise CalibrationError(f"target {spec!r}: expected for example {NOTATIONS}{why}") from None


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
    if count > 1 and len(corners.points) < 12 and errors[1] < AMBIGUOUS * max(float(errors[0]), 0.05):
        raise CalibrationError("the target is seen so straight on that it may be tilted either way")
    turn, shift = cv2.solvePnPRefineLM(corners.points, pixels, matrix, distortion, turns[0], shifts[0])
    return se3(cv2.Rodrigues(turn)[0], shift.ravel())


def to_gray(image: NDArray[np.uint8]) -> GrayImage:
    """Gray (H, W) of a gray, RGB or RGBA image."""
    if image.ndim == 2:
        return image
    code = cv2.COLOR_RGBA2GRAY if image.shape[2] == 4 else cv2.COLOR_RGB2GRAY
    return np.asarray(cv2.cvtColor(image, code), dtype=np.uint8)


def _charuco(name: str, squares: str, square: str, marker: str, dictionary: str = "4X4_50", *extra: str) -> Target:
    across, down = _counts(squares)
    side, inner = _meters(square), _meters(marker)
    if not inner < side or extra:
        raise ValueError("the markers must be smaller than the squares")
    board = cv2.aruco.CharucoBoard((across, down), side, inner, _dictionary(f"DICT_{dictionary.upper()}"))
    places = np.asarray(board.getChessboardCorners(), dtype=np.float64)
    printed = CharucoPrint(across, down, inner / side, dictionary.upper())

    # Corners so far by print, of pictures that tell the prints apart: a part of a board can fit both, a square apart,
    # and then the other pictures decide.
    total = [0, 0]

    def find(image: GrayImage) -> Corners | None:
        prints = find_charuco(image, printed)
        counts = [len(numbers) for _, numbers in prints]
        if max(counts) - min(counts) >= MIN_CORNERS:
            total[:] = [count + before for count, before in zip(counts, total)]
        pixels, numbers = prints[int(np.argmax(total if any(total) else counts))]
        if len(numbers) < MIN_CORNERS:
            return None
        points = places[numbers]
        if min(len(np.unique(points[:, 0].round(6))), len(np.unique(points[:, 1].round(6)))) < 2:
            return None  # all on one line
        return Corners(pixels + 0.5, points)

    def draw(width: int) -> GrayImage:
        return np.asarray(board.generateImage((width, round(width * down / across))), dtype=np.uint8)

    size = across * side, down * side

    def explain(image: GrayImage) -> str:
        return explain_charuco(image, printed)

    return Target(name, size, find, explain, draw, across, size, side, lambda: any(total) or down % 2 == 1)


def _chessboard(name: str, corners: str, square: str) -> Target:
    across, down = _counts(corners)
    side = _meters(square)
    if (across + down) % 2 == 0:
        raise ValueError("one of the numbers of corners must be odd and the other even, or up looks as down")
    y, x = np.mgrid[0:down, 0:across].reshape(2, -1) * side
    points = np.stack([x, y, np.zeros_like(x)], axis=1)
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK

    def find(image: GrayImage) -> Corners | None:
        found, pixels = cv2.findChessboardCorners(image, (across, down), flags=flags)
        if not found:
            return None
        pixels = pixels.reshape(down, across, 2)
        # A third of the distance to the nearest neighbor, so that the window holds no other corner.
        steps = [np.linalg.norm(np.diff(pixels, axis=k), axis=2).min() for k in (0, 1)]
        window = int(np.clip(min(steps) / 3, 2, 11))
        pixels = cv2.cornerSubPix(image, pixels.reshape(-1, 1, 2), (window, window), (-1, -1), _SUBPIX)
        pixels = pixels.reshape(down, across, 2).astype(np.float64)
        # The detector may start at either end: of the two end squares, the one at the first corner is darker.
        first = pixels[:2, :2].mean(axis=(0, 1))
        last = pixels[-2:, -2:].mean(axis=(0, 1))
        if _mean_level(image, first) > _mean_level(image, last):
            pixels = pixels[::-1, ::-1]
        return Corners(np.asarray(pixels.reshape(-1, 2) + 0.5, dtype=np.float64), points)

    def draw(width: int) -> GrayImage:
        # The detector needs white around the outer squares.
        cell = max(1, width // (across + 3))
        board = (np.indices((down + 1, across + 1)).sum(axis=0) % 2 * 255).astype(np.uint8)
        return np.pad(np.kron(board, np.ones((cell, cell), np.uint8)), cell, constant_values=255)

    def explain(image: GrayImage) -> str:
        for wider, taller in _OTHER_SIZES:
            size = across + wider, down + taller
            if min(size) >= 3 and cv2.findChessboardCorners(image, size, flags=flags)[0]:
                return f"a board of {size[0]}x{size[1]} inner corners is seen, not of {across}x{down}"
        return ""

    size, pattern = (((across + n) * side, (down + n) * side) for n in (3, 1))
    return Target(name, size, find, explain, draw, across + 3, pattern, side)


_MAKERS: dict[str, Callable[..., Target]] = {"charuco": _charuco, "chessboard": _chessboard}


def _mean_level(image: GrayImage, at: Array) -> float:
    x, y = np.rint(at).astype(int)
    return float(image[max(0, y - 1) : y + 2, max(0, x - 1) : x + 2].mean())


def _dictionary(name: str) -> cv2.aruco.Dictionary:
    if not hasattr(cv2.aruco, name):
        raise ValueError(f"no dictionary {name.removeprefix('DICT_')}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


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
