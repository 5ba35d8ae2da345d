"""Compare a mesh with the exact surface of a synthetic scene.

The ground truth is ray-cast: points of the analytic surface, one per cell of ``spacing_m``, with the number
of cameras that see each. A camera sees a point that lies in its image, that its ray hits first, and that
faces it within ``STEEPEST_DEG``. Depth from images needs two cameras, so completeness uses points that two or
more cameras see; accuracy uses all points that any camera sees.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.surface import SurfaceError
from edge_server.surface.mesh import Mesh

Points = NDArray[np.float64]

STEEPEST_DEG = 75.0
SEEN_BY = 2
WITHIN_M = 0.003
SAMPLES = 200_000


@dataclass(frozen=True)
class Truth:
    """points: (N, 3), meters. cameras: int64 (N,), number of cameras that see each point."""

    points: Points
    cameras: NDArray[np.int64]


@dataclass(frozen=True)
class MeshDistances:
    """A mesh compared with the true surface; distances in millimeters, and the project's targets, from 0.3 m.

    accuracy: from the mesh to the surface (mean, median, 95th percentile).
    completeness: mean from the surface that two cameras see to the mesh.
    chamfer: the mean of the two means.
    complete: share of that surface within ``within_mm`` of the mesh.
    precise: share of the mesh within ``within_mm`` of the surface.
    """

    chamfer_mm: float
    accuracy_mm: float
    accuracy_median_mm: float
    accuracy_p95_mm: float
    completeness_mm: float
    complete: float
    precise: float
    within_mm: float = 3.0
    target_chamfer_mm: float = 1.5
    target_complete: float = 0.95


def thin_points(points: Points, spacing_m: float) -> NDArray[np.int64]:
    """Indices of the first of points (N, 3) in every grid cell of side ``spacing_m``. Raises SurfaceError if
    the points span too many cells."""
    cells = np.floor(points / spacing_m).astype(np.int64)
    cells -= cells.min(axis=0, initial=0)
    x, y, z = (int(n) + 1 for n in cells.max(axis=0, initial=0))
    if x * y * z > 1 << 62:
        raise SurfaceError(f"points are too far apart for cells of {1e3 * spacing_m:g} mm")
    key = (cells[:, 0] * y + cells[:, 1]) * z + cells[:, 2]
    _, first = np.unique(key, return_index=True)
    return np.sort(first)


def sample_mesh(mesh: Mesh, count: int = SAMPLES, seed: int = 0) -> Points:
    """Sample ``count`` points (N, 3) uniformly over a mesh's area."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, 56]))
    area = mesh.areas_m2()
    edges = np.cumsum(area)
    # Stratified sampling over cumulative area: less noise than independent samples.
    at = (np.arange(count) + rng.random(count)) / count * edges[-1]
    face = np.minimum(np.searchsorted(edges, at, side="right"), len(area) - 1)
    a, b = rng.random((2, count))
    over = a + b > 1.0
    a, b = np.where(over, 1.0 - a, a), np.where(over, 1.0 - b, b)
    corner = mesh.vertices[mesh.faces[face]].astype(np.float64)
    points: Points = (
        corner[:, 0] + a[:, None] * (corner[:, 1] - corner[:, 0]) + b[:, None] * (corner[:, 2] - corner[:, 0])
    )
    return points


def compare(mesh: Mesh, truth: Truth, samples: int = SAMPLES) -> MeshDistances:
    """Measure ``mesh``. SurfaceError: one of the two has no surface."""
    from scipy.spatial import cKDTree

    asked = truth.points[truth.cameras >= SEEN_BY]
    if not len(mesh.faces) or not len(asked):
        raise SurfaceError("nothing to compare: the mesh, or what two cameras see, is empty")
    points = sample_mesh(mesh, samples)
    to_truth, _ = cKDTree(truth.points).query(points)
    to_mesh, _ = cKDTree(points).query(asked)
    return MeshDistances(
        chamfer_mm=500.0 * float(to_truth.mean() + to_mesh.mean()),
        accuracy_mm=1e3 * float(to_truth.mean()),
        accuracy_median_mm=1e3 * float(np.median(to_truth)),
        accuracy_p95_mm=1e3 * float(np.percentile(to_truth, 95)),
        completeness_mm=1e3 * float(to_mesh.mean()),
        complete=float((to_mesh <= WITHIN_M).mean()),
        precise=float((to_truth <= WITHIN_M).mean()),
        within_mm=1e3 * WITHIN_M,
    )
