"""Settings of meshes, and numbers of the distance function."""

from __future__ import annotations

from dataclasses import dataclass

from edge_server.surface import SurfaceError

METHODS = ("tsdf", "sdf")
MIN_WEIGHT = 0.2  # of a known voxel; a camera at normal incidence counts 1
MOST_VOXELS = 1 << 27  # of the box around the blocks: 512 MB of distances, and up to 3.2 GB if all lie near a surface
SHARPENED_PIXELS = 10_000_000  # of all maps that are sharpened: seven minutes of processor time, 41 s a million
COVERING_POINTS = 200  # of a map, by which is chosen what to sharpen
# The distance function: grids, each twice as fine as the last; Adam's steps and samples of each kind on each of them,
# and its learning rate in voxels; lambda of (3.15), and the weight of the third term.
SDF_LEVELS, SDF_STEPS, SDF_POINTS, SDF_RATE = 3, 60, 20_000, 0.1
SDF_EIKONAL, SDF_SIDES = 0.1, 1.0
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class MeshSettings:
    """How a mesh is made.

    method: tsdf (3.8-3.10) or sdf (3.12-3.15).
    sharpen: refine depth by photo-consistency (``refine_depth``).
    voxel_m: None: the size of a pixel at the surface.
    bounds: lower and upper corner, meters; None: from the depth maps.
    Raises SurfaceError for an unknown method.
    """

    method: str = "tsdf"
    sharpen: bool = True
    voxel_m: float | None = None
    bounds: tuple[Corner, Corner] | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise SurfaceError(f"method must be one of {', '.join(METHODS)}, not {self.method!r}")
