"""A field of its own for geometry, fitted when a mesh is asked for, before pictures decide (``sharpen``).

A field that is kept up to date for its looks may hold a surface several pixels too far off wherever texture
is weak: splats paint it from a haze. Explicit voxels (``fields.voxel``) that start anew on the same pictures
must empty every cell that some camera sees through, and stand where a plain background is hidden, textured
or not. Their depth is a better start for the sweep, and what remains where no two pictures agree.
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

STEPS = 600  # of 8192 rays
# Fewer pictures leave voxels room to explain them all without the surface: with ten of 48 x 48 the depth that
# came out was off by 7.7 mm (median) after 150 steps and by 10.5 after 400; with thirty of 64 x 64, less
# than 6 after 150.
LEAST_VIEWS = 30
KNOWN = 0.3  # trust, of the cosine, from which on what the pictures say stands
REST = 0.6  # trust, of the cosine, of what only the carved field says


def box_of(renderer: Renderer, views: Sequence[View]) -> SceneBox | None:
    """The box to carve: that of ``renderer``, if the scene ends there and there are ``LEAST_VIEWS``. Voxels
    of a scene without end are too large far away to tell where a surface is."""
    box = getattr(renderer, "box", None)
    ends = isinstance(box, SceneBox) and not box.contracted
    return box if ends and len(views) >= LEAST_VIEWS else None


def carved(
    box: SceneBox, background: Sequence[float] | None, views: Sequence[View], steps: int, pool: Pool | None
) -> Renderer:
    """Voxels fitted to ``views`` in ``steps`` steps, the same whatever the number of threads. background:
    the colour (3,) in [0, 1] behind the scene; None: found from the pictures."""
    from edge_server.fields.voxel.field import VoxelField
    from edge_server.fields.voxel.settings import make_settings

    options: dict[str, Any] = {
        "centre_m": box.centre_m, "radius_m": box.radius_m, "near_m": box.near_m, "contracted": False,
    }  # fmt: skip
    if background is not None:
        options["background"] = "#" + "".join(f"{round(255 * float(c)):02x}" for c in background)
    field = VoxelField(make_settings(options), pool)
    field.fit(views, Budget(steps=steps))
    return field.snapshot()


def completed(maps: Sequence[DepthMap], first: Sequence[DepthMap]) -> list[DepthMap]:
    """``maps`` with the depth of ``first`` wherever they know none, or hardly trust theirs."""
    out = []
    for found, start in zip(maps, first, strict=True):
        poor = start.seen & (found.trust < KNOWN * start.cosine)
        out.append(
            replace(
                found,
                depth=np.where(poor, start.depth, found.depth),
                trust=np.where(poor, np.float32(REST) * start.cosine, found.trust),
                cosine=np.where(poor, start.cosine, found.cosine),
            )
        )
    return out
