"""Contact shadows: moving bodies darken the floor beneath them, so that they do not seem to float."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.placement import MovingBody, PlacedParts
from freshfield.geometry import Array

# Distance (metres) from the body's middle at which its shadow ends.
_REACH_M = 0.8
_MOST_DARKENING = 0.75


def contact_shadow(
    body: MovingBody, placed: PlacedParts, floor_points: Array
) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
    """Which floor points a body darkens, and the share of their light that is left.

    A point loses the share of its sky that each contact sphere covers, r^2 cos / d^2.

    placed: the body's parts at an instant. floor_points: (3, N). Returns indices (K,) and shares (K,).
    """
    if not body.contact:
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.float32)
    spheres = np.array([[*placed.matrices[k, :3, 3], r] for k, r in body.contact])
    middle = spheres[:, :2].mean(axis=0)
    dx, dy = floor_points[0] - middle[0], floor_points[1] - middle[1]
    away2 = (dx * dx + dy * dy) / _REACH_M**2
    near = np.flatnonzero(away2 < 1.0)
    p = floor_points[:, near]
    covered = np.zeros(near.size)
    for x, y, z, r in spheres:
        # A sphere half sunk in the floor would cover more than all of it: lift it to rest on it.
        h = np.maximum(z - p[2], r)
        d2 = (p[0] - x) ** 2 + (p[1] - y) ** 2 + h * h
        covered += r * r * h / (d2 * np.sqrt(d2))
    # The window makes the truncation at the reach invisible.
    shadow = np.minimum(covered, _MOST_DARKENING) * (1.0 - away2[near])
    return near, (1.0 - shadow).astype(np.float32)
