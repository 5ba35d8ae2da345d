"""Exact depth of a world of analytic shapes, along the rays through the centers of a camera's pixels.

It is cast separately from images, whose rays need not pass through pixel centers, and only for cameras with a depth
sensor. Static parts are cast once per camera.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic.placement import place_parts, place_static
from camera_node.synthetic.render import World, cast_rays, rays_near_sphere
from freshfield.geometry import Array, Pinhole, world_rays


class DepthRenderer:
    """Casts one camera's depth, and keeps that of the static parts.

    camera: its lens, distortion included. camera_to_world: (4, 4).
    """

    def __init__(self, world: World, camera: Pinhole, camera_to_world: Array) -> None:
        self._world, self._shape = world, (camera.height, camera.width)
        self._origin, directions = world_rays(camera, camera_to_world)
        self._rays = np.ascontiguousarray(directions.reshape(-1, 3).T)
        self._along_axis = camera_to_world[:3, 2] @ self._rays  # depth of a unit of distance
        placed = place_static(world.static_parts)
        self._static, _ = cast_rays(self._origin, self._rays, placed, np.full(self._rays.shape[1], np.inf))

    def depth(self, t_s: float) -> NDArray[np.float32]:
        """Depth along the optical axis at an instant, float32 (H, W) in meters; 0 where a ray hits nothing."""
        distance = self._static.copy()
        for body in self._world.moving_bodies:
            placed = place_parts(body.parts, body.matrices(t_s))
            near = rays_near_sphere(self._origin, self._rays, *placed.bounding_sphere())
            distance[near], _ = cast_rays(self._origin, self._rays[:, near], placed, distance[near])
        depth = np.where(np.isfinite(distance), distance, 0.0) * self._along_axis
        return depth.reshape(self._shape).astype(np.float32)
