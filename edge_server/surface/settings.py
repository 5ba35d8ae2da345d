"""Settings of meshes."""

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
    Raises SurfaceError for an unknown method.
    """

    method: str = "tsdf"
    sharpen: bool = True
    voxel_m: float | None = None
    bounds: tuple[Corner, Corner] | None = None

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise SurfaceError(f"method must be one of {', '.join(METHODS)}, not {self.method!r}")
