"""Settings of meshes and of the distance function."""

from __future__ import annotations

from dataclasses import dataclass

from edge_server.surface import SurfaceError

METHODS = ("tsdf", "sdf")
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class MeshSettings:
    """How a mesh is made.

    method: tsdf (3.8-3.10) or sdf (3.12-3.15).
    sharpen: refine depth by photo-consistency (``refine_depth``).
    voxel_m: None: the size of a pixel at the surface.
    bounds: lower and upper corner, meters; None: from the depth maps.
    watertight: close the surface in unobserved space.
    min_weight: known voxels have more weight than this (a camera at normal incidence counts 1).
    memory_mb: largest size of the volume.
    Raises SurfaceError for an unknown method or a weight out of range.
    """

    method: str = "tsdf"
    sharpen: bool = True
    voxel_m: float | None = None
    bounds: tuple[Corner, Corner] | None = None
    watertight: bool = False
    min_weight: float = 0.2
    memory_mb: float = 2048.0

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise SurfaceError(f"method must be one of {', '.join(METHODS)}, not {self.method!r}")
        if not 0.0 <= self.min_weight <= 1e6:
            raise SurfaceError(f"min_weight must be in 0..1e+06, not {self.min_weight:g}")


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
