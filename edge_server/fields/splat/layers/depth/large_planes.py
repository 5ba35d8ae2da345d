"""Depth of what one camera alone sees, where it is a large plane of the scene that goes on: floor and walls.

Stereo needs two cameras. Of few, each sees much that no other does, most of it the rest of walls. Nothing lies behind
those, so that along a ray the nearest of them is what a camera sees, where it knows nothing better.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.surfaces import Surface

Array = NDArray[np.float64]


class Plane(NamedTuple):
    """normal: (3,), unit, towards the cameras. point: (3,), on it, world meters."""

    normal: Array
    point: Array


def large_planes(surfaces: Sequence[Surface], rng: np.random.Generator) -> list[Plane]:
    """Planes of the scene behind which next to nothing lies, the largest first.

    One after the other, by random sampling (Fischler and Bolles 1981): each draw is a point with its normal.
    surfaces: of all cameras. rng: draws points.
    """
    points, normals = (np.concatenate(part) for part in zip(*(_drawn(s, rng) for s in surfaces)))
    if not len(points):
        return []
    eye = np.mean([s.pose[:3, 3] for s in surfaces], axis=0)
    near_m = tuned.PLANE_NEAR * float(np.median(np.linalg.norm(points - eye, axis=1)))
    left, found = np.ones(len(points), bool), []
    for _ in range(tuned.PLANES):
        if np.count_nonzero(left) < tuned.PLANE_LEAST * len(points):
            break
        best, most = None, 0
        for k in rng.choice(np.flatnonzero(left), tuned.PLANE_DRAWS):
            plane = Plane(normals[k], points[k])
            count = int(np.count_nonzero(left & _on(plane, points, normals, near_m)))
            if count > most:
                best, most = plane, count
        if best is None or most < tuned.PLANE_LEAST * len(points):
            break
        for _ in range(2):
            best = _fitted(points, normals, left & _on(best, points, normals, near_m)) or best
        away_m = (points - best.point) @ best.normal
        left &= np.abs(away_m) >= near_m
        if np.count_nonzero(away_m < -2.0 * near_m) <= tuned.PLANE_BEHIND * len(points):
            found.append(best)
    return found


def continued(surface: Surface, planes: Sequence[Plane]) -> Surface:
    """The surface, with the nearest of the planes before the camera where its plate is known but its depth is not."""
    rays, origin = surface.rays() @ surface.pose[:3, :3].T, surface.pose[:3, 3]
    inverse = np.zeros(surface.inverse.shape)
    for plane in planes:
        height_m = float((origin - plane.point) @ plane.normal)
        if height_m > 0.0:
            inverse = np.maximum(inverse, -(rays @ plane.normal) / height_m)
    down, right = np.gradient(inverse)
    open_ = surface.known & (surface.inverse <= 0)
    return replace(
        surface,
        inverse=np.where(open_, inverse, surface.inverse).astype(np.float32),
        slope=np.where(open_[..., None], np.stack([right, down], axis=-1), surface.slope).astype(np.float32),
    )


def _drawn(surface: Surface, rng: np.random.Generator) -> tuple[Array, Array]:
    """Some of the points whose depth is known, and their normals, (N, 3) each."""
    there = np.flatnonzero(surface.depth() > 0)
    chosen = np.sort(rng.choice(there, min(tuned.PLANE_POINTS, len(there)), replace=False))
    return surface.points().reshape(-1, 3)[chosen], surface.normals().reshape(-1, 3)[chosen]


def _on(plane: Plane, points: Array, normals: Array, near_m: float) -> NDArray[np.bool_]:
    """Which points lie on a plane, as their normals do, (N,)."""
    near = np.abs((points - plane.point) @ plane.normal) < near_m
    return near & (normals @ plane.normal > tuned.PLANE_ALIKE)


def _fitted(points: Array, normals: Array, on: NDArray[np.bool_]) -> Plane | None:
    """The plane through points, by least squares; None through fewer than three."""
    if np.count_nonzero(on) < 3:
        return None
    middle = points[on].mean(axis=0)
    normal = np.linalg.svd(points[on] - middle, full_matrices=False)[2][2]
    return Plane(normal * np.sign(normal @ normals[on].mean(axis=0) or 1.0), middle)
