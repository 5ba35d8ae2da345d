"""Mesh extraction from a renderer and its cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from edge_server.fields import Renderer, View
from edge_server.surface import SurfaceError
from edge_server.surface import surface_constants as tuned
from edge_server.surface.depth import DepthMap, render_depth_maps
from edge_server.surface.mesh import extract_mesh, remove_small_components
from edge_server.surface.refine_depth import on_surface, refine_depth
from edge_server.surface.settings import MeshSettings
from edge_server.surface.surface_constants import COVERING_POINTS, MIN_WEIGHT, SHARPENED_PIXELS
from edge_server.surface.volume import Grid, bounding_box, fuse_maps

if TYPE_CHECKING:  # of the extra surface
    from trimesh import Trimesh

Say = Callable[[str, float], None]


def silent(what: str, share: float) -> None:
    """Report no progress."""


def make_depth_maps(
    renderer: Renderer, views: Sequence[View], settings: MeshSettings, say: Say = silent
) -> list[DepthMap]:
    """Make the depth maps that ``mesh_from_depth_maps`` fuses. Where not all are sharpened (``covering_maps``), the
    others have no trust.

    renderer: renders the field. views: the cameras, with their images.
    say: called with each stage and its completed share.
    Raises SurfaceError if there are no views.
    """
    if not views:
        raise SurfaceError("the field knows no cameras yet: fit it first")
    cameras = [(v.camera_to_world, v.intrinsics) for v in views]
    # A translucent initial surface is sufficient for refinement.
    solid = tuned.GUESS if settings.sharpen else tuned.SOLID
    maps = list(render_depth_maps(renderer, cameras, solid, lambda done: say("depth", done / len(views))))
    if not settings.sharpen or len(maps) < 2:
        return maps
    chosen = covering_maps(maps, SHARPENED_PIXELS)
    photos = [views[k].image for k in chosen]
    sharp = refine_depth([maps[k] for k in chosen], photos, None, lambda share: say("sharpen", share))
    untrusted = [replace(found, trust=np.zeros_like(found.trust)) for found in maps]
    return [dict(zip(chosen, sharp)).get(k, found) for k, found in enumerate(untrusted)]


def covering_maps(maps: Sequence[DepthMap], most_pixels: int) -> list[int]:
    """Numbers of the maps to sharpen, ascending: all, if they have at most ``most_pixels`` together. Else one by one
    the map that sees most, where a point counts half for each map before that sees it, until no other fits; at least
    two, because they are compared with each other."""
    if sum(found.depth.size for found in maps) <= most_pixels:
        return list(range(len(maps)))
    points = np.concatenate([found.points()[:: 1 + int(found.seen.sum()) // COVERING_POINTS] for found in maps])
    sees = np.stack([on_surface(found, points, tuned.GAIN_WITHIN) for found in maps])
    worth = 1.0 / np.maximum(sees.sum(axis=0), 1)  # a surface is sampled by each map that sees it
    chosen, left = list[int](), most_pixels
    for _ in maps:
        gain = sees @ worth
        gain[chosen] = -1.0
        best = int(gain.argmax())
        left -= maps[best].depth.size
        if left < 0 and len(chosen) >= 2:
            break
        chosen.append(best)
        worth[sees[best]] *= tuned.SEEN_AGAIN
    return sorted(chosen)


def mesh_from_depth_maps(maps: Sequence[DepthMap], settings: MeshSettings, say: Say = silent) -> Trimesh:
    """Extract the surface of ``maps``. say: called with each stage and its completed share. SurfaceError:
    there is no surface, or the settings do not allow it."""
    grid = grid_for(maps, settings)
    if settings.method == "sdf":
        from edge_server.surface.sdf import fit_sdf  # imports torch

        volume = fit_sdf(grid, maps, say)
    else:
        volume = fuse_maps(grid, maps, on_map=lambda done: say("fuse", done / len(maps)))
    mesh = remove_small_components(extract_mesh(volume, MIN_WEIGHT))
    say("extract", 1.0)
    return mesh


def grid_for(maps: Sequence[DepthMap], settings: MeshSettings) -> Grid:
    """The grid of a mesh, from the settings, else from the maps."""
    voxel_m = settings.voxel_m or pixel_m(maps)
    if settings.bounds is not None:
        lower, upper = settings.bounds
    else:
        lower, upper = bounding_box(maps, 2.0 * tuned.TRUNCATION * voxel_m)
    if settings.voxel_m is None:
        voxel_m = max(voxel_m, float(np.subtract(upper, lower).max()) / tuned.FINEST)
    return Grid(lower, upper, voxel_m, tuned.TRUNCATION * voxel_m)


def pixel_m(maps: Sequence[DepthMap]) -> float:
    """Size of a pixel at the surface, meters, median over the maps. SurfaceError: no surface."""
    spans = [float(np.median(m.depth[m.seen])) / min(m.intrinsics.fx, m.intrinsics.fy) for m in maps if m.seen.any()]
    if not spans:
        raise SurfaceError("no camera sees anything solid: fit the field longer")
    return float(np.median(spans))
