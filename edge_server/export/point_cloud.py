"""Points with colors and visibility from depth maps: COLMAP's sparse model."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from edge_server.export.colmap import Cloud
from edge_server.export.export_constants import SAME
from edge_server.surface.depth import DepthMap
from edge_server.surface.refine_depth import on_surface


def sparse_points(maps: Sequence[DepthMap], count: int) -> Cloud:
    """Up to ``count`` surface points, sampled evenly from all maps with trust, and the maps that see each."""
    points, colors, source = [], [], []
    trusted = [(k, found) for k, found in enumerate(maps) if found.trust.any()]
    for n, (k, found) in enumerate(trusted):
        share = (n + 1) * count // len(trusted) - n * count // len(trusted)  # fewer points than maps are some, too
        at = np.flatnonzero(found.seen)
        at = at[np.linspace(0, len(at) - 1, min(share, len(at))).round().astype(np.int64)] if len(at) else at
        lens, pose = found.intrinsics, found.camera_to_world
        pixels = np.stack([at % lens.width, at // lens.width], axis=-1) + 0.5
        rays = lens.rays(pixels) @ pose[:3, :3].T
        points.append(pose[:3, 3] + rays * found.depth.ravel()[at, None].astype(np.float64))
        colors.append(found.color.reshape(-1, 3)[at])
        source.append(np.full(len(at), k))
    every = np.concatenate(points) if points else np.zeros((0, 3))
    seen = np.zeros((len(every), len(maps)), np.bool_)
    for k, found in enumerate(maps):
        seen[:, k] = on_surface(found, every, SAME)
    if len(every):
        seen[np.arange(len(every)), np.concatenate(source)] = True
    return Cloud(every, np.concatenate(colors) if colors else np.zeros((0, 3), np.uint8), seen)
