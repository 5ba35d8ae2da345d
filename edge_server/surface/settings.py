"""Settings of meshes and of the distance function."""

from __future__ import annotations

from dataclasses import dataclass

from edge_server.surface import SurfaceError

METHODS = ("tsdf", "sdf")
MIN_WEIGHT = 0.2  # of a known voxel; a camera at normal incidence counts 1
MEMORY_MB = 2048.0  # largest size of a volume
SHARPENED_PIXELS = 10_000_000  # of all maps that are sharpened: seven minutes of processor time, 41 s a million
COVERING_POINTS = 200  # of a map, by which is chosen what to sharpen
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


@dataclass(frozen=True)
class SdfSettings:
    """How a distance function is fitted.

    levels: number of grids, each twice as fine as the last. steps: Adam steps per level.
    points: samples of each kind per step.
    eikonal: lambda of (3.15). sides: weight of the third term.
    rate: Adam's learning rate, in voxels of the level.
    """

    levels: int = 3
    steps: int = 60
    points: int = 20_000
    eikonal: float = 0.1
    sides: float = 1.0
    rate: float = 0.1
    seed: int = 0
