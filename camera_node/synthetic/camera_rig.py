"""Camera rigs: positions around a target, ordered so that any prefix is well spread."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from freshfield.geometry import Array, Pinhole, on_sphere

PosedCameras = dict[str, tuple[Pinhole, Array]]
Angles = tuple[float, float]  # azimuth and elevation, degrees


def rings(held_out: Angles, rows: Sequence[tuple[float, Sequence[float]]]) -> list[Angles]:
    """(Azimuth, elevation) of the held-out camera, and of those of each (elevation, azimuths)."""
    return [held_out, *((azimuth, elevation) for elevation, row in rows for azimuth in row)]


def spread_order(directions: Array) -> list[int]:
    """Farthest-point order of unit directions (N, 3), starting with the first, so that every prefix is well
    spread. Ties go to the lower index."""
    order = [0]
    nearest = directions @ directions[0]
    while len(order) < len(directions):
        nearest[order] = np.inf
        k = int(np.argmin(np.round(nearest, 9)))
        order.append(k)
        nearest = np.maximum(nearest, directions @ directions[k])
    return order


def build_rig(
    angles_deg: list[Angles], target: ArrayLike, radius_m: float, count: int, camera: Pinhole, outward: bool = False
) -> PosedCameras:
    """Cameras cam00, cam01, ... at (azimuth, elevation) around ``target``, looking at it or outward.

    angles_deg: the first entry is cam00, which is held out; the others are numbered in spread order.
    count: number of cameras; a smaller one omits the last names, and the others keep their poses.
    camera: intrinsics of all cameras.
    """
    poses = [on_sphere(target, radius_m, a, e, outward) for a, e in angles_deg]
    away = np.stack([-p[:3, 2] for p in poses])
    order = spread_order(away)
    return {f"cam{k:02d}": (camera, poses[i]) for k, i in enumerate(order[:count])}
