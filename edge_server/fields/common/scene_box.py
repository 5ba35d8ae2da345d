"""The scene's box, found from the cameras: poses are normalized by it before a field is trained (4.4.4).

The thesis re-centers the world on the geometric center of the cameras. For cameras that look inwards, the
point nearest to their optical axes is better, so it is taken where there is one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields import field_constants as tuned
from edge_server.fields.common.background import plain_background
from freshfield.geometry import converging_point

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SceneBox:
    """Scene coordinates are (world - center_m) / radius_m.

    contracted: whether the scene goes on beyond the box.
    near_m: how near to a camera density may be.
    distance_m: median distance of the cameras to the center.
    pixel_m: width of a pixel there, for most cameras.
    """

    center_m: tuple[float, float, float]
    radius_m: float
    near_m: float
    contracted: bool
    distance_m: float
    pixel_m: float

    @property
    def pixels_across(self) -> float:
        """The encoding's cube in pixels: no camera sees finer detail."""
        return (4.0 if self.contracted else 2.0) * self.radius_m / self.pixel_m

    def normalise(self, points_m: Array) -> Array:
        """World meters (..., 3) -> scene units."""
        return (points_m - np.asarray(self.center_m)) / self.radius_m


# The box of a field that has seen nothing yet.
UNIT_BOX = SceneBox((0.0, 0.0, 0.0), 1.0, 0.1, False, 1.0, 0.01)


def scene_box(
    views: Sequence[View],
    center_m: tuple[float, float, float] | None = None,
    radius_m: float | None = None,
    near_m: float | None = None,
    contracted: bool | None = None,
) -> SceneBox:
    """The box for these views; arguments that are not None are kept, the others are found from the cameras.

    Pictures with transparency or before one plain color show an object: the box is what nearly all
    cameras see around the point they look at. Otherwise the surroundings belong to the scene: the box
    reaches from there to the cameras, and space beyond it is contracted.
    """
    poses = np.stack([v.camera_to_world for v in views])
    origins, axes = poses[:, :3, 3], poses[:, :3, 2]
    point = _meeting_point(origins, axes)
    if center_m is not None:
        center = np.asarray(center_m, dtype=np.float64)
    elif point is not None:
        center = point
    elif len(views) > 1 and np.linalg.norm(axes.mean(axis=0)) < tuned.OUTWARDS:
        center = _main_group(origins).mean(axis=0)  # looking outwards
    else:
        # Nothing tells how far the scene is: a few times the group's own extent, or a room's width.
        group = _main_group(origins)
        spread = float(np.linalg.norm(group - group.mean(axis=0), axis=1).max())
        ahead_m = tuned.GUESSED_SPREADS * spread if spread > 1e-3 else tuned.GUESSED_M
        center = group.mean(axis=0) + axes.mean(axis=0) * ahead_m
    distance = float(np.median(np.linalg.norm(origins - center, axis=1)))
    distance = distance if distance > 1e-6 else 1.0
    pixel = distance / float(np.median([v.intrinsics.fx for v in views]))
    if contracted is None:
        transparent = any(v.image.shape[2] == 4 for v in views)
        contracted = not transparent and plain_background(views) is None
    if radius_m is None:
        radius_m = distance if contracted else _seen_radius(views, center)
    if near_m is None:
        before = max(tuned.NEAR_LEAST * distance, distance - tuned.NEAR_RADII * radius_m)
        near_m = tuned.NEAR_SHARE * distance if contracted else before
    x, y, z = map(float, center)
    return SceneBox((x, y, z), float(radius_m), float(near_m), contracted, distance, pixel)


def _meeting_point(origins: Array, axes: Array) -> Array | None:
    """``converging_point`` without outliers, cameras that look past it while all others meet there: a wrong
    pose in the first views must not decide for good where the scene is. At most a quarter are left out, and
    none of three.
    """
    point = converging_point(origins, axes)
    kept = np.ones(len(origins), np.bool_)
    for _ in range(len(origins) // 4):
        if point is None:
            break
        worst = int(np.argmax(np.where(kept, _off_axis(origins, axes, point), -1.0)))
        kept[worst] = False
        others = converging_point(origins[kept], axes[kept])
        if others is None:
            break
        past = _off_axis(origins, axes, others)
        if past[worst] < max(tuned.ASTRAY, tuned.ASTRAY_MEDIANS * float(np.median(past[kept]))):
            break
        point = others
    if point is not None and _agreed(origins, axes, point):
        return point
    # A camera that is far away moves the point so far that the right ones seem as wrong as it is.
    better = _where_most_meet(origins, axes)
    if better is not None or point is None:
        return better
    return point if np.median(_off_axis(origins, axes, point)) < tuned.ASIDE else None


def _where_most_meet(origins: Array, axes: Array) -> Array | None:
    """The point where at least three quarters of the cameras look, if any, found by trying pairs of them."""
    some = np.unique(np.linspace(0, len(origins) - 1, tuned.MOST_TRIED).astype(int))
    i, j = (some[k] for k in np.triu_indices(len(some), 1))
    projectors = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    both = projectors[i] + projectors[j]
    apart = np.linalg.eigvalsh(both)[:, 0] > 1e-3 if len(i) else np.zeros(0, np.bool_)
    if len(origins) < 4 or not apart.any():
        return None
    place = (projectors @ origins[:, :, None])[:, :, 0]
    points = np.linalg.solve(both[apart], (place[i] + place[j])[apart][:, :, None])[:, :, 0]
    astray = np.median(_off_axis(origins, axes, points), axis=-1)
    first = int(np.argmin(astray))
    past = _off_axis(origins, axes, points[first])
    kept = past <= max(tuned.ASTRAY, tuned.ASTRAY_MEDIANS * float(astray[first]))
    if astray[first] >= tuned.MEETS or 4 * np.count_nonzero(~kept) > len(origins):
        return None
    point = converging_point(origins[kept], axes[kept])
    # From very far away, a camera may look past the point by kilometers at a small angle.
    return point if point is not None and _agreed(origins, axes, point) else points[first]


def _agreed(origins: Array, axes: Array, point: Array) -> bool:
    return bool(np.median(_off_axis(origins, axes, point)) < tuned.MEETS)


def _off_axis(origins: Array, axes: Array, point: Array) -> Array:
    """The sine of the angle by which cameras (N,) look past a point (3,), or past each of several (M, 3) ->
    (M, N); 1 and more where it is behind them."""
    to_point = point[..., None, :] - origins
    ahead = (to_point * axes).sum(axis=-1) / np.maximum(np.linalg.norm(to_point, axis=-1), 1e-12)
    return np.where(ahead < 0.0, 1.0 - ahead, np.sqrt(np.maximum(1.0 - ahead**2, 0.0)))


def _main_group(origins: Array) -> Array:
    """The positions of the cameras without those far from the others; all, if those are over a quarter."""
    apart = np.linalg.norm(origins - np.median(origins, axis=0), axis=1)
    kept = apart <= tuned.FAR_AWAY * max(float(np.median(apart)), 1e-3)
    return origins[kept] if 4 * np.count_nonzero(~kept) <= len(origins) else origins


def _seen_radius(views: Sequence[View], center: Array) -> float:
    """Radius in meters of the ball around ``center`` that nine of ten cameras see whole."""
    radii = []
    for view in views:
        camera = view.intrinsics
        half = min(0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy)
        distance = np.linalg.norm(view.camera_to_world[:3, 3] - center)
        radii.append(distance * half / np.hypot(1.0, half))
    return max(float(np.percentile(radii, tuned.SEEN_PERCENTILE)), 1e-6)
