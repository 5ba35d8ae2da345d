"""Refines the corners of a dark square on white by fitting lines to its sides.

Gradient-based corner refinement is made for saddle points such as those of a chessboard. At the outer corner
of a square it ends a quarter to half a pixel inside, which puts a tag of 80 mm 1 mm farther away at 20 cm.
Here each side is a line through the points where gray is half way between dark and light, and the corners are
the intersections. On rendered tags they are right to a tenth of a pixel.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# Positions along a side, as shares of its length. The ends are left out because of the corners.
_SHARES = np.linspace(0.06, 0.94, 64)
_MIN_SAMPLES = 10
_ROUNDS = 2
# Across a side, in pixels.
_STEP_PX = 0.25


def square_corners(picture: NDArray[np.uint8], corners: Array) -> Array:
    """Refined corners (4, 2), with pixel centers at whole numbers; ``corners`` themselves if a side is not
    visible. If only parts of a side are dark, as in a QR code, those parts are used."""
    better = corners
    for _ in range(_ROUNDS):
        lines = [_side(picture, better, k) for k in range(4)]
        if any(line is None for line in lines):
            return corners
        meets = [_intersection(lines[k - 1], lines[k]) for k in range(4)]  # type: ignore[arg-type]
        if any(m is None for m in meets):
            return corners
        better = np.array(meets)
    reach = _reach(corners)
    # Far from the detector's corners, another line was mistaken for a side.
    return better if np.abs(better - corners).max() <= 2 * reach else corners


def _side(picture: NDArray[np.uint8], corners: Array, k: int) -> tuple[Array, Array] | None:
    """Point (2,) and direction (2,) of side k, from corner k to the next."""
    start, end = corners[k], corners[(k + 1) % 4]
    along = end - start
    across = np.array([along[1], -along[0]]) / np.linalg.norm(along)
    if across @ (start - corners.mean(axis=0)) < 0:
        across = -across  # outward
    reach = _reach(corners)
    depth = np.arange(-reach, reach + _STEP_PX / 2, _STEP_PX)
    at = start + _SHARES[:, None, None] * along + depth[:, None] * across
    gray = cv2.remap(
        picture,
        at[..., 0].astype(np.float32),
        at[..., 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).astype(np.float64)
    ends = max(2, len(depth) // 6)
    inside, outside = gray[:, :ends].mean(axis=1), gray[:, -ends:].mean(axis=1)
    contrast = outside - inside
    seen = contrast > 0.6 * np.quantile(contrast, 0.9)
    if seen.sum() < _MIN_SAMPLES or np.quantile(contrast, 0.9) < 10:
        return None
    half = (inside + outside) / 2
    light = gray >= half[:, None]
    # The outermost dark position.
    last = len(depth) - 1 - np.argmax(~light[:, ::-1], axis=1)
    seen &= (last < len(depth) - 1) & ~light[:, 0]
    rows = np.flatnonzero(seen)
    if len(rows) < _MIN_SAMPLES:
        return None
    before, after = gray[rows, last[rows]], gray[rows, last[rows] + 1]
    share = (half[rows] - before) / np.maximum(after - before, 1e-9)
    edge = start + _SHARES[rows, None] * along + ((depth[last[rows]] + share * _STEP_PX)[:, None] * across)
    vx, vy, x, y = cv2.fitLine(edge.astype(np.float32), cv2.DIST_HUBER, 0, 0.01, 0.01).ravel()
    return np.array([x, y], dtype=np.float64), np.array([vx, vy], dtype=np.float64)


def _intersection(a: tuple[Array, Array], b: tuple[Array, Array]) -> Array | None:
    directions = np.stack([a[1], -b[1]], axis=1)
    if abs(np.linalg.det(directions)) < 1e-3:
        return None
    return np.asarray(a[0] + np.linalg.solve(directions, b[0] - a[0])[0] * a[1])


def _reach(corners: Array) -> float:
    """Half width (pixels) of the search across an edge: less than a module of the coarsest code."""
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return float(np.clip(sides.min() / 40, 2.0, 5.0))
