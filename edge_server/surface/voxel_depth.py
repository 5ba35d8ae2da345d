"""A voxel field for geometry, fitted before mesh extraction; its depth initializes ``refine_depth``.

A field trained for appearance may place a surface several pixels too far where texture is weak: splats render
it from semi-transparent haze. A new voxel field (``fields.voxel``) on the same images must empty every cell
that some camera sees through, and fill cells that hide a plain background, textured or not. Its depth is a
better start for the sweep, and the fallback where no two images agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from edge_server.fields import Budget, Renderer, View
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.surface.depth import DepthMap

STEPS = 600  # training steps of 8192 rays
# With fewer images, voxels can explain them all without the surface. Median depth error: ten images of
# 48 x 48, 7.7 mm after 150 steps and 10.5 mm after 400; thirty of 64 x 64, below 6 mm after 150.
MIN_VIEWS = 30
RELIABLE_TRUST = 0.3  # trust as a share of the cosine; from here on the swept depth is kept
VOXEL_TRUST = 0.6  # trust as a share of the cosine, for depth from the voxel field alone


def voxel_box(renderer: Renderer, views: Sequence[View]) -> SceneBox | None:
    """The box of ``renderer``, if it bounds the scene and there are ``MIN_VIEWS``; else None. Far voxels of
    an unbounded scene are too large to locate a surface."""
    box = getattr(renderer, "box", None)
    ends = isinstance(box, SceneBox) and not box.contracted
    return box if ends and len(views) >= MIN_VIEWS else None


def fit_voxels(
    box: SceneBox, background: Sequence[float] | None, views: Sequence[View], steps: int, pool: Pool | None
) -> Renderer:
    """Fit voxels to ``views`` in ``steps`` steps; the result does not depend on the number of threads.
    background: color (3,) in [0, 1] behind the scene; None: estimated from the images."""
    from edge_server.fields.voxel.field import VoxelField
    from edge_server.fields.voxel.settings import VoxelSettings

    options: dict[str, Any] = {
        "centre_m": box.centre_m, "radius_m": box.radius_m, "near_m": box.near_m, "contracted": False,
    }  # fmt: skip
    if background is not None:
        options["background"] = "#" + "".join(f"{round(255 * float(c)):02x}" for c in background)
    field = VoxelField(VoxelSettings(**options), pool)
    field.fit(views, Budget(steps=steps))
    return field.snapshot()


def fill_depth(maps: Sequence[DepthMap], first: Sequence[DepthMap]) -> list[DepthMap]:
    """Replace depth in ``maps`` that is missing or has low trust by the depth of ``first``."""
    out = []
    for found, start in zip(maps, first, strict=True):
        poor = start.seen & (found.trust < RELIABLE_TRUST * start.cosine)
        out.append(
            replace(
                found,
                depth=np.where(poor, start.depth, found.depth),
                trust=np.where(poor, np.float32(VOXEL_TRUST) * start.cosine, found.trust),
                cosine=np.where(poor, start.cosine, found.cosine),
            )
        )
    return out
