"""Triangle meshes: extraction from a volume by marching cubes, and removal of small components."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.surface import SurfaceError
from edge_server.surface.kernels.fuse import CELLS, SIDE
from edge_server.surface.volume import Volume, unblock

Floats = NDArray[np.float32]

SLAB_CELLS = 1 << 24  # voxels per marching cubes call: 64 MB, and a few times that inside the call
LAYER_CELLS = 1 << 23  # voxels in one layer, at most; the thinnest slab has SIDE layers
LEAST = 1e-3  # voxels; a distance of exactly 0 puts a vertex on a voxel and makes degenerate triangles
KEEP_SHARE = 0.002  # share of the largest component's area; smaller components are removed
INSTALL = "marching cubes needs scikit-image: pip install 'freshfield[surface]'"


@dataclass(frozen=True)
class Mesh:
    """vertices: float32 (V, 3), world meters. faces: int32 (F, 3), counter-clockwise seen from outside.
    color: uint8 (V, 3)."""

    vertices: Floats
    faces: NDArray[np.int32]
    color: NDArray[np.uint8]

    @property
    def watertight(self) -> bool:
        """Whether every edge belongs to exactly two faces with opposite directions along it."""
        if not len(self.faces):
            return False
        edges = self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64)
        count = len(self.vertices)
        one, other = np.sort(edges[:, 0] * count + edges[:, 1]), np.sort(edges[:, 1] * count + edges[:, 0])
        return bool((one[1:] != one[:-1]).all() and np.array_equal(one, other))

    def areas_m2(self) -> NDArray[np.float64]:
        """Area of every face (F,), square meters."""
        corners = self.vertices[self.faces].astype(np.float64)
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        areas: NDArray[np.float64] = 0.5 * np.linalg.norm(cross, axis=1)
        return areas


def extract_mesh(
    volume: Volume, min_weight: float = 0.0, watertight: bool = False, on_slab: Callable[[float], None] | None = None
) -> Mesh:
    """Extract the zero level set (Lorensen and Cline 1987, in Lewiner's topologically sound variant).

    min_weight: voxels need more fused weight than this to be known; faces connect only known voxels.
    watertight: treat space in the box that no camera looked through as solid; this closes the surface.
    on_slab: called with the completed share. SurfaceError: scikit-image is missing, or there is no surface.
    """
    marching_cubes = import_marching_cubes()
    dense = _Dense(volume, min_weight, watertight)
    vertices: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    seams: dict[bytes, int] = {}
    count = 0
    for first, last in dense.slabs():
        distance, known = dense.slab(first, last)
        # scikit-image reads a cell's mask at its upper corner.
        cells = np.zeros(known.shape, np.bool_)
        cells[1:, 1:, 1:] = _all_corners(known) & _crosses_surface(distance)
        if cells.any():
            points, triangles, *_ = marching_cubes(distance, 0.0, mask=cells)
            points = points.astype(np.float64) + np.array([first, 0, 0])
            number = _merge_seams(points, count, (first, last), seams)
            new = number >= count
            vertices.append(points[new])
            faces.append(number[triangles])
            count += int(new.sum())
        if on_slab is not None:
            on_slab(last / (dense.span[0] - 1))
    if not count:
        raise SurfaceError("the depth maps hold no surface within the bounds")
    index = np.concatenate(vertices)
    color = dense.colors(index)
    meters = dense.meters(index)
    mesh = Mesh(meters.astype(np.float32), np.concatenate(faces).astype(np.int32), color)
    return remove_degenerate(mesh)


def import_marching_cubes() -> Callable[..., Any]:
    """scikit-image's marching cubes. SurfaceError where it is not installed."""
    try:
        from skimage.measure import marching_cubes
    except ImportError:
        raise SurfaceError(INSTALL) from None
    return marching_cubes


def _merge_seams(
    points: NDArray[np.float64], count: int, planes: tuple[int, int], seams: dict[bytes, int]
) -> NDArray[np.int64]:
    """Vertex indices of ``points`` (N, 3); new indices start at ``count``. Points on a plane between slabs
    share one index: both slabs compute them from the same voxels, so they are equal bit for bit."""
    number = np.full(len(points), -1, np.int64)
    at_seam = np.isin(points[:, 0], planes)
    for k in np.flatnonzero(at_seam):
        number[k] = seams.get(points[k].tobytes(), -1)
    fresh = number < 0
    number[fresh] = count + np.arange(int(fresh.sum()))
    for k in np.flatnonzero(at_seam & fresh):
        seams[points[k].tobytes()] = int(number[k])
    return number


def _all_corners(known: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether all corners of each cell (X - 1, Y - 1, Z - 1) are known."""
    a = known[1:] & known[:-1]
    a = a[:, 1:] & a[:, :-1]
    found: NDArray[np.bool_] = a[:, :, 1:] & a[:, :, :-1]
    return found


def _crosses_surface(distance: Floats) -> NDArray[np.bool_]:
    """Whether the surface passes through each cell (X - 1, Y - 1, Z - 1)."""
    inside = distance < 0
    some, every = inside, inside
    for axis in range(3):
        a, b = [slice(None)] * 3, [slice(None)] * 3
        a[axis], b[axis] = slice(1, None), slice(None, -1)
        some = some[tuple(a)] | some[tuple(b)]
        every = every[tuple(a)] & every[tuple(b)]
    return some & ~every


class _Dense:
    """Slabs of a volume as dense arrays. Indices start at the first voxel of block ``low``. A watertight
    surface adds one empty layer before the first voxel and one after the last; indices include it."""

    def __init__(self, volume: Volume, min_weight: float, watertight: bool) -> None:
        self.volume, self.min_weight, self.watertight = volume, min_weight, watertight
        place = volume.blocks.place
        if not len(place):
            raise SurfaceError("the depth maps hold no surface within the bounds")
        low, high = place.min(axis=0), place.max(axis=0) + 1
        if watertight:
            low, high = np.zeros(3, np.int64), volume.grid.blocks
        self.pad = int(watertight)
        self.low, self.high = low.astype(np.int64), high.astype(np.int64)
        self.span = tuple(int(n) for n in (self.high - self.low) * SIDE + 2 * self.pad)
        if self.span[1] * self.span[2] > LAYER_CELLS:
            raise SurfaceError("the volume is too wide for one slab: take larger voxels or smaller bounds")

    def slabs(self) -> list[tuple[int, int]]:
        """(first, last) layers along x; neighboring slabs share one layer."""
        layers = max(SIDE, SLAB_CELLS // (self.span[1] * self.span[2]))
        end = self.span[0] - 1
        return [(x, min(x + layers, end)) for x in range(0, end, layers)]

    def slab(self, first: int, last: int) -> tuple[Floats, NDArray[np.bool_]]:
        """Distances of layers first to last inclusive, and whether each is known."""
        grid, blocks, pad = self.volume.grid, self.volume.blocks, self.pad
        inner = self.span[0] - 2 * pad
        begin, end = max(first - pad, 0), min(last + 1 - pad, inner)  # voxels
        b0, b1 = begin // SIDE, -(-end // SIDE)
        box = (slice(self.low[0] + b0, self.low[0] + b1), *map(slice, self.low[1:], self.high[1:]))
        part = self.volume.table[box]
        known = part >= 0
        distance = np.full((*part.shape, CELLS), grid.band_m, np.float32)
        sure = np.zeros((*part.shape, CELLS), np.bool_)
        distance[known] = blocks.distance[part[known]]
        sure[known] = blocks.weight[part[known]] > self.min_weight
        if self.watertight:
            distance = np.where(sure, distance, np.float32(-grid.band_m))
            free = self.volume.through[box] & ~known
            distance[free] = grid.band_m
            sure[:] = True
        cut = slice(begin - b0 * SIDE, end - b0 * SIDE)
        least = np.float32(LEAST * grid.voxel_m)
        dense, known = unblock(distance)[cut], unblock(sure)[cut]
        dense = np.where(np.abs(dense) < least, np.where(dense < 0, -least, least), dense)
        if pad:
            width = ((pad - (first > 0), pad - (last < self.span[0] - 1)), (1, 1), (1, 1))
            dense = np.pad(dense, width, constant_values=grid.band_m)
            known = np.pad(known, width, constant_values=True)
        return np.ascontiguousarray(dense), known

    def meters(self, index: NDArray[np.float64]) -> NDArray[np.float64]:
        """World coordinates (N, 3), meters, of voxel indices (N, 3)."""
        grid = self.volume.grid
        voxels = index - self.pad + SIDE * self.low
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
        block, inside = np.divmod(index - self.pad + SIDE * self.low, SIDE)
        within = ((block >= 0) & (block < table.shape)).all(axis=1)
        number = np.where(within, table[tuple(np.where(within[:, None], block, 0).T)], -1)
        cell = (inside[:, 0] * SIDE + inside[:, 1]) * SIDE + inside[:, 2]
        sums = self.volume.blocks.color[np.maximum(number, 0), cell].astype(np.float64)
        return np.where(number[:, None] >= 0, sums, 0.0)


def remove_degenerate(mesh: Mesh) -> Mesh:
    """Remove faces of zero area and unused vertices."""
    corners = mesh.faces
    apart = (corners[:, 0] != corners[:, 1]) & (corners[:, 1] != corners[:, 2]) & (corners[:, 2] != corners[:, 0])
    return _select_faces(mesh, apart & (mesh.areas_m2() > 0.0))


def remove_small_components(mesh: Mesh, keep_share: float = KEEP_SHARE) -> Mesh:
    """Keep components with at least ``keep_share`` of the largest area."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    if not len(mesh.faces):
        return mesh
    a, b = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    count = len(mesh.vertices)
    graph = coo_matrix((np.ones(len(a), np.int8), (a, b)), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    of_face = label[mesh.faces[:, 0]]
    area = np.bincount(of_face, weights=mesh.areas_m2())
    return _select_faces(mesh, (area >= keep_share * area.max())[of_face])


def _select_faces(mesh: Mesh, which: NDArray[np.bool_]) -> Mesh:
    faces = mesh.faces[which]
    used = np.zeros(len(mesh.vertices), np.bool_)
    used[faces] = True
    number = np.cumsum(used) - 1
    return Mesh(mesh.vertices[used], number[faces].astype(np.int32), mesh.color[used])
