"""Compares a run's mesh with the true surface that its cameras saw, which is known for static synthetic
scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from camera_node.settings import WorldConfig, source_config
from camera_node.synthetic.placement import PlacedParts, place_static
from camera_node.synthetic.render import cast_rays, surface_properties
from camera_node.synthetic.scene import Scene
from edge_server.experiments.virtual.from_scenario import exact_scene
from edge_server.fields import View
from edge_server.surface.mesh import Mesh
from edge_server.surface.metrics import STEEPEST_DEG, WITHIN_M, MeshDistances, Truth, compare, thin_points
from freshfield.geometry import seen_from, world_rays
from freshfield.scenario import load

# Spacing of the points of the truth: half the distance that counts as complete; casting the rays then takes
# seconds instead of minutes.
SPACING_M = 0.5 * WITHIN_M
_FINE = 3  # rays per pixel side for the truth, so that they are closer than its spacing
_SAME = 2e-3  # share of the distance: a ray that ends this near to its target has reached it


def compare_with_scene(scenario: str) -> Callable[[Mesh, Sequence[View]], str]:
    """The function with which ``edge-server export --measure`` measures a mesh: it returns ``distances`` in one line of
    text. Raises ScenarioError immediately, before there is a mesh."""
    return partial(_compare, still_scene(scenario))


def _compare(scene: Scene | None, mesh: Mesh, views: Sequence[View]) -> str:
    if scene is None:
        return "not measured: the true surface is known of synthetic scenes that stand still"
    found = distances(mesh, scene, views)
    return (
        f"chamfer {found.chamfer_mm:.2f} mm (target {found.target_chamfer_mm:g}), "
        f"{100 * found.complete:.1f} % of the surface within {found.within_mm:g} mm "
        f"(target {100 * found.target_complete:g})"
    )


def still_scene(scenario: str) -> Scene | None:
    """A scenario's scene; None if its surface is unknown: with recorded data, real cameras or a moving scene.
    Raises ScenarioError."""
    loaded = load(scenario)
    source = source_config(loaded)
    if not isinstance(source, WorldConfig):
        return None
    scene = exact_scene(loaded, source)
    return None if scene.moving else scene


def distances(mesh: Mesh, scene: Scene, views: Sequence[View]) -> MeshDistances:
    """A mesh compared with the surface that cameras see of a scene. Raises SurfaceError if one of the two is
    empty."""
    return compare(mesh, surface_truth(scene, views))


def surface_truth(scene: Scene, views: Sequence[View], spacing_m: float = SPACING_M) -> Truth:
    """The object's surface that the cameras of views see (``surface.metrics.Truth``)."""
    placed = place_static(scene.world.static_parts)
    parts = scene.object_parts
    parts = len(placed.parts) if parts is None else parts
    points, normals = [], []
    for view in views:
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
    for view in views:
        count += _sees(view, placed, every, all_normals)
    return Truth(every, count)


def _sees(
    view: View, placed: PlacedParts, points: NDArray[np.float64], normals: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether a camera sees each of the surface points (N, 3) with ``normals`` (N, 3); returns (N,)."""
    pose, lens = view.camera_to_world, view.intrinsics
    inside = seen_from(lens, pose, points)[2]
    ray = points - pose[:3, 3]
    distance = np.linalg.norm(ray, axis=1)
    ray /= distance[:, None]
    turned = -(ray * normals).sum(axis=1) >= np.cos(np.deg2rad(STEEPEST_DEG))
    asked = np.flatnonzero(inside & turned)
    t, _ = cast_rays(pose[:3, 3], np.ascontiguousarray(ray[asked].T), placed, np.full(len(asked), np.inf))
    out = np.zeros(len(points), np.bool_)
    out[asked] = np.abs(t - distance[asked]) <= _SAME * distance[asked]
    return out
