"""A close scan of ``tile`` with its exact depth: images from five cameras around each of some points on it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from camera_node.synthetic.scene import Scene
from edge_server.fields import View
from freshfield.geometry import Pinhole, on_sphere

DISTANCE_M, FOV_DEG = 0.3, 50.0
# (azimuth, elevation) of the cameras around a point.
ANGLES_DEG = ((0.0, 88.0), (0.0, 45.0), (90.0, 45.0), (180.0, 45.0), (270.0, 45.0))


@dataclass(frozen=True)
class Scan:
    """A scan. scene: the scene with the close cameras. views: their images."""

    scene: Scene
    views: tuple[View, ...]


def scan(size: int, raster: tuple[tuple[float, float, float], ...]) -> Scan:
    """Scan with images of ``size`` x ``size`` pixels from five cameras per point of ``raster``."""
    scene = make_scene("tile", {"count": 1, "width": size, "height": size})
    lens = Pinhole.from_fov(size, size, FOV_DEG)
    poses = [on_sphere(p, DISTANCE_M, a, e) for p in raster for a, e in ANGLES_DEG]
    scene = replace(scene, cameras={f"scan{k:02d}": (lens, pose) for k, pose in enumerate(poses)})
    views = tuple(View(f"scan{k:02d}", scene.view(lens, p).image(0.0), p, lens) for k, p in enumerate(poses))
    return Scan(scene, views)


def exact_depth(scene: Scene, view: View) -> NDArray[np.float64]:
    """Distance (H, W) along the ray through every pixel's center; inf if it meets nothing."""
    renderer = replace(scene, params=msgspec.structs.replace(scene.params, supersample=1)).view(
        view.intrinsics, view.camera_to_world
    )
    return renderer.distance()
