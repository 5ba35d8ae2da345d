"""First Gaussians straight from depth plates: flat ones that lie on the surfaces."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.kernels.optimizer_step import clamp_gaussians
from edge_server.fields.splat.kernels.project import BASE, COLOR, OPACITY, QUATERNION, SCALE, SH_COLUMNS
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.surfaces import Surface
from edge_server.fields.splat.settings import SplatSettings


def first_gaussians(
    surfaces: Sequence[Surface], box: SceneBox, settings: SplatSettings, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Parameters of up to ``settings.start`` Gaussians, float32 (N, P), at pixels drawn from all plates with depth.

    Each covers its share of the pixels, as a disc on the surface; thin across it.
    """
    known = [s.depth() > 0 for s in surfaces]
    total = sum(int(k.sum()) for k in known)
    count = min(settings.start, settings.gaussians, total)
    drawn = np.sort(rng.choice(total, count, replace=False))
    params = np.zeros((count, BASE + SH_COLUMNS * settings.sh_degree), np.float32)
    spacing = np.sqrt(total / max(count, 1))
    begin = row = 0
    for surface, there in zip(surfaces, known):
        pixels = np.flatnonzero(there)
        mine = pixels[drawn[(drawn >= begin) & (drawn < begin + pixels.size)] - begin]
        rows, begin, row = slice(row, row + mine.size), begin + pixels.size, row + mine.size
        params[rows, :3] = box.normalise(surface.points().reshape(-1, 3)[mine])
        width = tuned.FIRST_SIZE * spacing * surface.depth().ravel()[mine] / (surface.lens.fx * box.radius_m)
        params[rows, SCALE : SCALE + 2] = np.log(width)[:, None]
        params[rows, SCALE + 2] = np.log(tuned.FIRST_THICKNESS * width)
        normal = surface.normals().reshape(-1, 3)[mine]
        normal *= np.where(normal[:, 2] < 0, -1.0, 1.0)[:, None]  # a disc has two sides
        # The rotation from the z axis to the normal.
        quaternion = np.stack([1.0 + normal[:, 2], -normal[:, 1], normal[:, 0], np.zeros(mine.size)], axis=1)
        params[rows, QUATERNION:OPACITY] = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
        params[rows, COLOR : COLOR + 3] = surface.color.reshape(-1, 3)[mine] / 255.0
    params[:, OPACITY] = np.log(tuned.FIRST_OPACITY / (1.0 - tuned.FIRST_OPACITY))
    clamp_gaussians(params)
    return params
