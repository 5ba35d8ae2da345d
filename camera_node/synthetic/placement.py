"""Where parts stand: world-from-local matrices (4, 4)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


def at(x: float, y: float, z: float, turn_deg: float = 0.0) -> Array:
    """Moved to a place (metres), turned about the vertical."""
    a = np.deg2rad(turn_deg)
    out = np.eye(4)
    out[:2, :2] = [[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]]
    out[:3, 3] = x, y, z
    return out


def facing(x_axis: Vector, y_axis: Vector, centre: Vector) -> Array:
    """With local x and y along the axes given, which are orthogonal and of unit length."""
    out = np.eye(4)
    out[:3, 0], out[:3, 1], out[:3, 3] = x_axis, y_axis, centre
    out[:3, 2] = np.cross(x_axis, y_axis)
    return out
