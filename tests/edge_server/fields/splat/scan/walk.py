"""A camera walks around a small scene, with depth, and with errors of poses and exposures that vary slowly."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from freshfield.geometry import Pinhole, look_at, so3_exp, world_rays
from tests.edge_server.fields.scenes import seen

LENS = Pinhole.from_fov(48, 40, 55.0)


@cache
def walk(count: int = 80, depth: bool = True) -> list[View]:
    """Frames of an arc around the scene, 10 a second."""
    views, blank = [], np.zeros((LENS.height, LENS.width), np.float32)
    for k in range(count):
        angle = 1.8 * np.pi * k / count
        pose = look_at(2.2 * np.array([np.cos(angle), np.sin(angle), 0.5]), (0.0, 0.0, 0.3))
        image = np.zeros((LENS.height, LENS.width, 3), np.uint8)
        view = View(f"{k:03d}", image, pose, LENS, k * 100_000_000, depth=blank if depth else None)
        views.append(at(pose, view))
    return views


def at(pose: NDArray[np.float64], view: View) -> View:
    """The view from ``pose`` instead, with depth if it has some."""
    image, away_m = seen(LENS, pose)
    measured = np.where(np.isfinite(away_m), away_m * world_rays(LENS, np.eye(4))[1][..., 2], 0.0)
    depth = None if view.depth is None else measured.astype(np.float32)
    return replace(view, image=image, camera_to_world=pose, depth=depth)


def spoiled(views: list[View], deg: float = 1.0, shift_m: float = 0.02, gain: float = 0.25) -> list[View]:
    """With errors of poses and exposures that vary slowly along the way."""
    out = []
    for k, view in enumerate(views):
        phase, pose = 0.25 * k, view.camera_to_world.copy()
        pose[:3, :3] = pose[:3, :3] @ so3_exp(np.deg2rad(deg) * np.array([np.sin(phase), np.cos(phase), 0.3]))
        pose[:3, 3] += shift_m * np.array([np.cos(phase), 0.2, np.sin(phase)])
        image = np.clip(view.image * (1.0 + gain * np.sin(0.4 * k)), 0, 255).astype(np.uint8)
        out.append(replace(view, camera_to_world=pose, image=image))
    return out


WALK = walk()
