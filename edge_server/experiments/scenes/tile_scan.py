"""A close scan of ``tile`` and the exact surface that it shows, for measuring meshes.

Cameras are ``DISTANCE_M`` from a grid of points on the tile, as an arm would hold one: straight above each
point, and tilted to four sides. They do not see the tile's lower side, and its carrier's walls only
obliquely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from camera_node.config import WorldConfig, source_config
from camera_node.robot.arm.viewpoint_tour import viewpoints
from camera_node.synthetic import make_scene
from camera_node.synthetic.camera_rig import on_sphere
from camera_node.synthetic.placement import PlacedParts, place_static
from camera_node.synthetic.render import cast_rays, surface_properties
from camera_node.synthetic.scene import Scene
from edge_server.experiments.scenes.multiview_still import known_options
from edge_server.fields import View
from edge_server.surface.metrics import STEEPEST_DEG, Truth, thin_points
from freshfield.geometry import Array, Pinhole, world_rays
from freshfield.scenario import load

DISTANCE_M = 0.3
FOV_DEG = 50.0
# Points of the tile's upper side, and (azimuth, elevation) of the cameras around each.
RASTER_M = tuple((x, y, 0.03) for y in (-0.13, 0.0, 0.13) for x in (-0.19, -0.065, 0.065, 0.19))
ANGLES_DEG = ((0.0, 88.0), (0.0, 45.0), (90.0, 45.0), (180.0, 45.0), (270.0, 45.0))
SPACING_M = 0.0005  # between points of the truth
_FINE = 3  # rays per pixel side for the truth, so that they are closer than its spacing
_SAME = 2e-3  # share of the distance: a ray that ends this near to its target has reached it


@dataclass(frozen=True)
class Scan:
    """A scan. scene: the scene with the close cameras. views: their images, supersampled."""

    scene: Scene
    views: tuple[View, ...]

    @property
    def options(self) -> dict[str, object]:
        """Options of a field that are known in a robot cell."""
        return known_options(self.scene, 0.3 * DISTANCE_M)


def scan(size: int = 256, raster: tuple[tuple[float, float, float], ...] = RASTER_M) -> Scan:
    """Scan with images of ``size`` x ``size`` pixels from five cameras per point of ``raster``."""
    return _scan_from([on_sphere(p, DISTANCE_M, a, e) for p in raster for a, e in ANGLES_DEG], size, FOV_DEG)


def cell_scan(size: int) -> Scan:
    """Scan of the tile from the viewpoints of scenario ``cell``, with exact poses and images of ``size`` x
    ``size`` pixels."""
    source = source_config(load("cell"))
    assert isinstance(source, WorldConfig) and source.arm is not None and source.arm.path is not None
    assert source.horizontal_fov_deg is not None
    return _scan_from(viewpoints(source.arm.path), size, source.horizontal_fov_deg)


def _scan_from(poses: Sequence[Array], size: int, fov_deg: float) -> Scan:
    scene = make_scene("tile", {"count": 1, "width": size, "height": size})
    lens = Pinhole.from_fov(size, size, fov_deg)
    cameras = {f"scan{k:02d}": (lens, pose) for k, pose in enumerate(poses)}
    scene = scene.with_cameras(cameras)
    views = tuple(View(name, scene.view(lens, pose).image(0.0), pose, lens) for name, (lens, pose) in cameras.items())
    return Scan(scene, views)


def exact_depth(scene: Scene, view: View) -> NDArray[np.float64]:
    """Distance (H, W) along the ray through every pixel's center; inf if it meets nothing."""
    renderer = replace(scene, params=msgspec.structs.replace(scene.params, supersample=1)).view(
        view.intrinsics, view.camera_to_world
    )
    return renderer.distance()


def surface_truth(scan: Scan, spacing_m: float = SPACING_M) -> Truth:
    """The object's surface that the scan's cameras see (``surface.metrics.Truth``)."""
    placed = place_static(scan.scene.world.static_parts)
    parts = scan.scene.object_parts
    parts = len(placed.parts) if parts is None else parts
    points, normals = [], []
    for view in scan.views:
        fine = view.intrinsics.scaled(_FINE)
        origin, rays = world_rays(fine, view.camera_to_world)
        rays = np.ascontiguousarray(rays.reshape(-1, 3).T)
        t, which = cast_rays(origin, rays, placed, np.full(rays.shape[1], np.inf))
        hit = np.flatnonzero((which >= 0) & (which < parts))
        met = origin[:, None] + t[hit] * rays[:, hit]
        _, facing = surface_properties(placed, which[hit], met, rays[:, hit])
        seen = -(facing * rays[:, hit]).sum(axis=0) >= np.cos(np.deg2rad(STEEPEST_DEG))
        first = thin_points(met.T[seen], spacing_m)
        points.append(met.T[seen][first])
        normals.append(facing.T[seen][first])
    every, all_normals = np.concatenate(points), np.concatenate(normals)
    first = thin_points(every, spacing_m)
    every, all_normals = every[first], all_normals[first]
    count = np.zeros(len(every), np.int64)
    for view in scan.views:
        count += _sees(view, placed, every, all_normals)
    return Truth(every, count)


def _sees(
    view: View, placed: PlacedParts, points: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether a camera sees each of the surface points (N, 3) with ``normals`` (N, 3); returns (N,)."""
    pose, lens = view.camera_to_world, view.intrinsics
    with np.errstate(invalid="ignore"):
        at = lens.project((points - pose[:3, 3]) @ pose[:3, :3])
        inside = ((at >= 0) & (at < (lens.width, lens.height))).all(axis=1)
    ray = points - pose[:3, 3]
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    turned = -(ray * normals).sum(axis=1) >= np.cos(np.deg2rad(STEEPEST_DEG))
    asked = np.flatnonzero(inside & turned)
    t, _ = cast_rays(pose[:3, 3], np.ascontiguousarray(ray[asked].T), placed, np.full(len(asked), np.inf))
    out = np.zeros(len(points), np.bool_)
    out[asked] = np.abs(t - distance[asked]) <= _SAME * distance[asked]
    return out
