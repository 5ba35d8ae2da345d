"""Triangle meshes: extraction from a volume by marching cubes, and removal of small components."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.surface import SurfaceError
from edge_server.surface import surface_constants as tuned
from edge_server.surface.kernels.fuse import CELLS, SIDE
from edge_server.surface.volume import Volume, unblock

if TYPE_CHECKING:  # of the extra surface
    from trimesh import Trimesh

Floats = NDArray[np.float32]

NO_SURFACE = "the depth maps hold no surface within the bounds"
INSTALL = "a mesh needs scikit-image and trimesh: pip install 'freshfield[surface]'"


def extract_mesh(volume: Volume, min_weight: float = 0.0) -> Trimesh:
    """Extract the zero level set (Lorensen and Cline 1987, in Lewiner's topologically sound variant): in world meters,
    faces counter-clockwise seen from outside, with colors of vertices.

    min_weight: voxels need more fused weight than this to be known; faces connect only known voxels.
    SurfaceError: scikit-image or trimesh is missing, or there is no surface.
    """
    marching_cubes = import_marching_cubes()
    from trimesh import Trimesh

    dense = _Dense(volume, min_weight)
    distance, known = dense.distances()
    # scikit-image reads a cell's mask at its upper corner.
    cells = np.zeros(known.shape, np.bool_)
    cells[1:, 1:, 1:] = _all_corners(known)
    try:
        points, faces, *_ = marching_cubes(distance, 0.0, mask=cells)
    except (RuntimeError, ValueError):  # no cell, or none that the surface crosses
        raise SurfaceError(NO_SURFACE) from None
    index = points.astype(np.float64)
    vertices = dense.meters(index).astype(np.float32)  # as files have them: what they merge has no area
    return remove_degenerate(Trimesh(vertices, faces, vertex_colors=dense.colors(index), process=False))


def import_marching_cubes() -> Callable[..., Any]:
    """scikit-image's marching cubes. SurfaceError where it, or trimesh, is not installed."""
    try:
        import trimesh  # noqa: F401
        from skimage.measure import marching_cubes
    except ImportError:
        raise SurfaceError(INSTALL) from None
    return marching_cubes


def _all_corners(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether all corners of each cell (X - 1, Y - 1, Z - 1) are known."""
    a = known[1:] & known[:-1]
    a = a[:, 1:] & a[:, :-1]
    found: NDArray[np.bool_] = a[:, :, 1:] & a[:, :, :-1]
    return found


class _Dense:
    """A volume as dense arrays. Indices start at the first voxel of block ``low``."""

    def __init__(self, volume: Volume, min_weight: float) -> None:
        self.volume, self.min_weight = volume, min_weight
        place = volume.blocks.place
        if not len(place):
            raise SurfaceError(NO_SURFACE)
        low, high = place.min(axis=0), place.max(axis=0) + 1
        self.low, self.high = low.astype(np.int64), high.astype(np.int64)

    def distances(self) -> tuple[Floats, NDArray[np.bool_]]:
        """Distances of all voxels (X, Y, Z), meters, and whether each is known."""
        grid, blocks = self.volume.grid, self.volume.blocks
        table = self.volume.table[tuple(map(slice, self.low, self.high))]
        known = table >= 0
        distance = np.full((*table.shape, CELLS), grid.band_m, np.float32)
        sure = np.zeros((*table.shape, CELLS), np.bool_)
        distance[known] = blocks.distance[table[known]]
        sure[known] = blocks.weight[table[known]] > self.min_weight
        least = np.float32(tuned.LEAST * grid.voxel_m)
        dense, sure = unblock(distance), unblock(sure)
        dense = np.where(np.abs(dense) < least, np.where(dense < 0, -least, least), dense)
        return np.ascontiguousarray(dense), sure

    def meters(self, index: NDArray[np.float64]) -> NDArray[np.float64]:
        """World coordinates (N, 3), meters, of voxel indices (N, 3)."""
        grid = self.volume.grid
        voxels = index + SIDE * self.low
        meters: NDArray[np.float64] = np.array(grid.lower) + voxels * grid.voxel_m
        return meters

    def colors(self, index: NDArray[np.float64]) -> NDArray[np.uint8]:
        """Colors (N, 3) at indices (N, 3), interpolated between two voxels; gray where unknown."""
        low, high = np.floor(index).astype(np.int64), np.ceil(index).astype(np.int64)
        share = (index - low).max(axis=1, keepdims=True)
        sums = (1.0 - share) * self._color_sums(low) + share * self._color_sums(high)
        mean = sums[:, :3] / np.maximum(sums[:, 3:], 1e-9)
        return np.where(sums[:, 3:] > 0, np.rint(mean), 128).astype(np.uint8)

    def _color_sums(self, index: NDArray[np.int64]) -> NDArray[np.float64]:
        """Weighted colors and weights (N, 4) of voxels; 0 outside the blocks."""
        table = self.volume.table
        block, inside = np.divmod(index + SIDE * self.low, SIDE)
        within = ((block >= 0) & (block < table.shape)).all(axis=1)
        number = np.where(within, table[tuple(np.where(within[:, None], block, 0).T)], -1)
        cell = (inside[:, 0] * SIDE + inside[:, 1]) * SIDE + inside[:, 2]
        sums = self.volume.blocks.color[np.maximum(number, 0), cell].astype(np.float64)
        return np.where(number[:, None] >= 0, sums, 0.0)


def remove_degenerate(mesh: Trimesh) -> Trimesh:
    """The mesh without faces of zero area."""
    return _with_faces(mesh, mesh.area_faces > 0.0)


def remove_small_components(mesh: Trimesh, keep_share: float = tuned.KEEP_SHARE) -> Trimesh:
    """The components with at least ``keep_share`` of the largest area."""
    from trimesh.graph import connected_component_labels

    if not len(mesh.faces):
        return mesh
    label = connected_component_labels(mesh.edges, node_count=len(mesh.vertices))[mesh.faces[:, 0]]
    area = np.bincount(label, weights=mesh.area_faces)
    return _with_faces(mesh, (area >= keep_share * area.max())[label])


def _with_faces(mesh: Trimesh, which: NDArray[np.bool_]) -> Trimesh:
    found = mesh.copy()
    found.update_faces(which)
    found.remove_unreferenced_vertices()
    return found
