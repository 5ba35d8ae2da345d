"""A sparse truncated signed distance field from depth maps (thesis 3.8-3.10).

Blocks of 8 x 8 x 8 voxels within the truncation of a depth map's surface are allocated and fused; the others
are one table entry each. Each voxel sums the maps in order, so the result is the same bit for bit on any
number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.supervision import lens_row
from edge_server.fields.common.threads.thread_pool import Pool, shared_pool
from edge_server.surface import SurfaceError
from edge_server.surface import surface_constants as tuned
from edge_server.surface.depth import DepthMap
from edge_server.surface.kernels.fuse import CELLS, FAR, SIDE, Blocks, KernelDepth, fuse
from edge_server.surface.surface_constants import MOST_VOXELS


@dataclass(frozen=True)
class Grid:
    """The voxel grid. lower, upper: (3,) meters, corners of the box. voxel_m: side of a voxel. band_m:
    truncation, d_max of (3.8). Raises SurfaceError for an impossible or too fine grid."""

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    voxel_m: float
    band_m: float

    def __post_init__(self) -> None:
        finite = np.isfinite([*self.lower, *self.upper, self.voxel_m, self.band_m]).all()
        if not finite or not self.voxel_m > 0 or not all(low < high for low, high in zip(self.lower, self.upper)):
            raise SurfaceError(
                "each lower corner must be below its upper one, and voxels larger than 0: "
                f"{1e3 * self.voxel_m:g} mm in {self.describe()}"
            )
        entries = np.prod(self.blocks.astype(float))
        if entries > tuned.MAX_BLOCKS:
            least = self.voxel_m * (entries / tuned.MAX_BLOCKS) ** (1 / 3)
            raise SurfaceError(
                f"{1e3 * self.voxel_m:g} mm voxels are too many in {self.describe()}: "
                f"take {1e3 * least:.2g} mm or more, or smaller bounds"
            )

    @property
    def blocks(self) -> NDArray[np.int64]:
        """Blocks along each axis (3,)."""
        span = np.subtract(self.upper, self.lower)
        return np.maximum(np.ceil(span / (SIDE * self.voxel_m)), 1).astype(np.int64)

    def describe(self) -> str:
        """The box as readable text."""
        return " x ".join(f"{a:.3g}..{b:.3g}" for a, b in zip(self.lower, self.upper)) + " m"


@dataclass(frozen=True)
class Volume:
    """Fused blocks. table: int32 (X, Y, Z), block index or -1."""

    grid: Grid
    blocks: Blocks
    table: NDArray[np.int32]


def bounding_box(
    maps: Sequence[DepthMap], margin_m: float
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Lower and upper corner, meters, of the maps' points without outliers, plus a margin. SurfaceError:
    there are no points."""
    points = [m.points()[:: max(1, m.depth.size // tuned.BOX_POINTS)] for m in maps]
    every = np.concatenate(points) if points else np.zeros((0, 3))
    if not len(every):
        raise SurfaceError("no camera sees anything solid: fit the field longer")
    low, high = np.quantile(every, [tuned.OUTLIERS, 1.0 - tuned.OUTLIERS], axis=0)
    a, b = low - margin_m, high + margin_m
    return (float(a[0]), float(a[1]), float(a[2])), (float(b[0]), float(b[1]), float(b[2]))


def fuse_maps(
    grid: Grid, maps: Iterable[DepthMap], pool: Pool | None = None, on_map: Callable[[int], None] | None = None
) -> Volume:
    """Fuse ``maps`` in order. on_map: called with the count done. Raises SurfaceError if the box around what is near
    a surface has more than ``MOST_VOXELS``."""
    maps = list(maps)
    pool = pool or shared_pool()
    table = np.full(tuple(grid.blocks), -1, np.int32)
    place = np.argwhere(blocks_near_surfaces(grid, maps)).astype(np.int32)
    voxels = float(np.prod((np.ptp(place, axis=0) + 1.0) * SIDE)) if len(place) else 0.0
    if voxels > MOST_VOXELS:
        least_m = grid.voxel_m * (voxels / MOST_VOXELS) ** (1 / 3)
        raise SurfaceError(
            f"a mesh at {1e3 * grid.voxel_m:g} mm has too many voxels: take {1e3 * least_m:.2g} mm or more, or smaller "
            "bounds"
        )
    table[tuple(place.T)] = np.arange(len(place), dtype=np.int32)
    blocks = Blocks(
        place=place,
        lowest=np.array(grid.lower, np.float64),
        distance=np.full((len(place), CELLS), grid.band_m, np.float32),
        weight=np.zeros((len(place), CELLS), np.float32),
        color=np.zeros((len(place), CELLS, 4), np.float32),
    )
    for done, found in enumerate(maps, 1):
        pool.run(fuse, blocks, kernel_depth(found), float(grid.voxel_m), float(grid.band_m))
        if on_map is not None:
            on_map(done)
    return Volume(grid, blocks, table)


def unblock(blocks: NDArray) -> NDArray:
    """Reshape blocks of voxels (X, Y, Z, CELLS) to one array (SIDE X, SIDE Y, SIDE Z)."""
    x, y, z = blocks.shape[:3]
    layers = blocks.reshape(x, y, z, SIDE, SIDE, SIDE).transpose(0, 3, 1, 4, 2, 5)
    return layers.reshape(x * SIDE, y * SIDE, z * SIDE)


def kernel_depth(found: DepthMap) -> KernelDepth:
    """Convert a depth map to the kernel's input."""
    return KernelDepth(
        lens=np.array(lens_row(found.intrinsics), dtype=np.float64),
        rotation=np.ascontiguousarray(found.camera_to_world[:3, :3]),
        origin=np.ascontiguousarray(found.camera_to_world[:3, 3]),
        depth=np.where(found.depth < np.inf, found.depth, np.float32(FAR)),
        trust=np.ascontiguousarray(found.trust),
        cosine=np.ascontiguousarray(found.cosine),
        color=np.ascontiguousarray(found.color),
    )


def blocks_near_surfaces(grid: Grid, maps: Sequence[DepthMap]) -> NDArray[np.bool_]:
    """Which blocks (X, Y, Z) come within the truncation of a depth map's points."""
    wanted = np.zeros(tuple(grid.blocks), np.bool_)
    side = SIDE * grid.voxel_m
    # Half a block beyond the band includes blocks that the band only touches.
    reach = grid.band_m + 0.5 * side
    offsets = np.linspace(-reach, reach, 1 + 2 * max(1, int(np.ceil(2.0 * reach / side))))
    for found in maps:
        pose, seen = found.camera_to_world, found.seen
        if not seen.any():
            continue
        rays = found.intrinsics.rays()[seen] @ pose[:3, :3].T
        depth = found.depth[seen].astype(np.float64)
        # Pixels wider than half a block leave gaps: points between them are added.
        wide = float(np.median(depth)) / min(found.intrinsics.fx, found.intrinsics.fy)
        spread = int(np.ceil(wide / (0.5 * side))) - 1
        for offset in offsets:
            points = pose[:3, 3] + rays * (depth + offset)[:, None]
            at = np.floor((points - np.array(grid.lower)) / side).astype(np.int64)
            at = at[((at >= 0) & (at < grid.blocks)).all(axis=1)]
            if spread > 0:
                steps = np.stack(np.meshgrid(*[np.arange(-spread, spread + 1)] * 3), axis=-1).reshape(-1, 3)
                at = (np.unique(at, axis=0)[:, None] + steps).reshape(-1, 3)
                at = at[((at >= 0) & (at < grid.blocks)).all(axis=1)]
            wanted[tuple(at.T)] = True
    return wanted
