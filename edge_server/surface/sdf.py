"""A signed distance function fitted to depth (thesis 3.12-3.15), an alternative to TSDF fusion.

d_theta of (3.14) is a grid of distances with trilinear interpolation, fitted from coarse to fine by Adam. The
loss is that of (3.15): |d| at observed surface points, and the eikonal term (|grad d| - 1)^2 over the domain
Omega. (3.15) alone does not determine the inside, so a third term makes d positive before a surface point on
its ray and negative behind it (3.12), by at least half the distance to a plane there.

The fitted distances replace those of a fused volume; its weights and colors are unchanged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from edge_server.surface import SurfaceError
from edge_server.surface import surface_constants as tuned
from edge_server.surface.depth import DepthMap
from edge_server.surface.kernels.fuse import CELLS, SIDE
from edge_server.surface.volume import Grid, Volume, fuse_maps


def fit_sdf(grid: Grid, maps: Sequence[DepthMap], say: Callable[[str, float], None] | None = None) -> Volume:
    """Fit a function to ``maps`` and return its distances as a volume.

    say: called with the stage and its completed share.
    Raises SurfaceError if torch is missing, the grid is too fine, or there is nothing to fit.
    """
    volume = fuse_maps(grid, maps)
    samples = _samples(grid, maps)
    if not len(samples[0]):
        raise SurfaceError("no camera sees anything solid within the bounds")
    nodes = int(np.prod(grid.blocks * SIDE))
    if nodes > tuned.MAX_NODES:
        least = grid.voxel_m * (nodes / tuned.MAX_NODES) ** (1 / 3)
        raise SurfaceError(
            f"a distance function at {1e3 * grid.voxel_m:g} mm has too many nodes: take {1e3 * least:.2g} mm "
            "or more, smaller bounds, or method tsdf"
        )
    distance = _optimize(grid, samples, say)
    x, y, z = grid.blocks
    blocked = distance.reshape(x, SIDE, y, SIDE, z, SIDE).transpose(0, 2, 4, 1, 3, 5).reshape(x, y, z, CELLS)
    clipped = np.clip(blocked[tuple(volume.blocks.place.T)], -grid.band_m, grid.band_m)
    return replace(volume, blocks=volume.blocks._replace(distance=clipped.astype(np.float32)))


def _samples(grid: Grid, maps: Sequence[DepthMap]) -> tuple[NDArray[np.float32], ...]:
    """Of pixels that see a surface within the grid: points (N, 3), meters from the grid's lower corner, rays (N, 3),
    away from the camera, and cosine and trust (N,)."""
    found = []
    for m in maps:
        at = m.points() - np.array(grid.lower)
        inside = ((at > 0) & (at < np.subtract(grid.upper, grid.lower))).all(axis=1)
        rays = m.intrinsics.rays()[m.seen] @ m.camera_to_world[:3, :3].T
        found.append([part[inside] for part in (at, rays, m.cosine[m.seen], m.trust[m.seen])])
    return tuple(np.concatenate(part).astype(np.float32) for part in zip(*found))


def _optimize(
    grid: Grid, samples: tuple[NDArray[np.float32], ...], say: Callable[[str, float], None] | None
) -> NDArray[np.float32]:
    """Distances (X, Y, Z) at the grid's voxels, meters. samples: see ``_samples``."""
    try:
        import torch
        from torch.nn.functional import interpolate
    except ImportError:
        raise SurfaceError("method sdf needs torch: pip install 'freshfield[edge]'") from None
    generator = torch.Generator().manual_seed(0)
    points, rays, cosine, trust = map(torch.from_numpy, samples)
    chances = (trust.double() / trust.double().sum()).cumsum(0)
    size = tuple(int(n) for n in grid.blocks * SIDE)
    # All distances start slightly positive; the sides term and the surface points make the inside negative.
    values = torch.full((1, 1, *_coarse_shape(size, tuned.SDF_LEVELS - 1)), 0.5 * grid.band_m)
    for level in range(tuned.SDF_LEVELS):
        scale = 2 ** (tuned.SDF_LEVELS - 1 - level)
        voxel = grid.voxel_m * scale
        shape = _coarse_shape(size, tuned.SDF_LEVELS - 1 - level)
        if level:
            values = interpolate(values, size=shape, mode="trilinear", align_corners=True)
        values = values.detach().clone().requires_grad_()
        extent = torch.tensor([(n - 1) * voxel for n in shape])
        optimizer = torch.optim.Adam([values], lr=tuned.SDF_RATE * voxel, betas=tuned.SDF_BETAS)
        for step in range(tuned.SDF_STEPS):
            # Sample by trust; searchsorted does what multinomial would, without its limit of 2^24.
            tickets = torch.rand(tuned.SDF_POINTS, generator=generator, dtype=torch.float64)
            drawn = torch.searchsorted(chances, tickets).clamp_(max=len(chances) - 1)
            loss = _loss(values, extent, voxel, grid.band_m, points[drawn], rays[drawn], cosine[drawn], generator)
            left = tuned.SDF_RATE_END ** (step / tuned.SDF_STEPS)
            optimizer.param_groups[0]["lr"] = tuned.SDF_RATE * voxel * left
            optimizer.zero_grad(set_to_none=True)
            loss.backward()
            optimizer.step()
            if say is not None and (step + 1) % tuned.SDF_SAYS_EVERY == 0:
                say("sdf", (level + (step + 1) / tuned.SDF_STEPS) / tuned.SDF_LEVELS)
    found: NDArray[np.float32] = values.detach().numpy()[0, 0]
    return found


def _coarse_shape(size: tuple[int, ...], halvings: int) -> tuple[int, ...]:
    return tuple(max(2, -(-n // 2**halvings)) for n in size)


def _loss(values, extent, voxel, band, points, rays, cosine, generator):
    """(3.15) plus the sides term, on distances in voxels, so that its scale is the same on every level."""
    import torch

    reach = torch.rand(len(points), generator=generator) * band
    along = (reach * cosine)[:, None]
    before, behind = points - rays * reach[:, None], points + rays * reach[:, None]
    # Free space: a random point between the camera and the band before the surface.
    far = torch.rand(len(points), generator=generator)[:, None]
    free = points - rays * (band + far * (extent.max() - band))
    inside = ((free > 0) & (free < extent)).all(dim=1)
    on = sample_grid(values, points, extent)
    front, back, clear = (
        sample_grid(values, before, extent),
        sample_grid(values, behind, extent),
        sample_grid(values, free, extent),
    )
    sides = torch.relu(0.5 * along[:, 0] - front).mean() + torch.relu(0.5 * along[:, 0] + back).mean()
    sides = sides + (torch.relu(0.5 * band - clear) * inside).mean()
    domain = torch.cat([points, before, behind])[torch.randperm(3 * len(points), generator=generator)[: len(points)]]
    steep = gradient_norm(values, domain, extent, voxel)
    eikonal = ((steep - 1.0) ** 2).mean()
    return on.abs().mean() / voxel + tuned.SDF_SIDES * sides / voxel + tuned.SDF_EIKONAL * eikonal


def sample_grid(values, points, extent):
    """Interpolate grid values (1, 1, X, Y, Z) at points (N, 3), meters from the grid's corner: (N,)."""
    from torch.nn.functional import grid_sample

    where = (2.0 * points / extent - 1.0).flip(-1).view(1, -1, 1, 1, 3)  # grid_sample wants the last axis first
    return grid_sample(values, where, mode="bilinear", padding_mode="border", align_corners=True).view(-1)


def gradient_norm(values, points, extent, voxel):
    """|grad d| (N,) by central differences over one voxel to each side (3.13)."""
    import torch

    steps = torch.eye(3) * voxel
    parts = [sample_grid(values, points + e, extent) - sample_grid(values, points - e, extent) for e in steps]
    return (torch.stack(parts).pow(2).sum(0) / (2.0 * voxel) ** 2 + 1e-12).sqrt()
