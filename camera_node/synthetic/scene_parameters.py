"""The parameters that every scene has."""

from __future__ import annotations

import math
from typing import Annotated

from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.settings import Settings, within

MAX_SPEED_M_PER_S = 8.0
"""Of what moves."""
MAX_CAMERAS = 19
"""Of a scene, with the held-out one."""
Fov = Annotated[float, within(5.0, 150.0, "horizontal field of view of the cameras")]


class BaseParams(Settings, frozen=True, kw_only=True):
    """Parameters every scene has."""

    count: Annotated[int, within(1, MAX_CAMERAS, "cameras, with the held-out one")] = 13
    width: Annotated[int, within(8, MAX_IMAGE_SIDE_PX, "pixels")] = 128
    height: Annotated[int, within(8, MAX_IMAGE_SIDE_PX, "pixels")] = 128
    horizontal_fov_deg: Fov = 60.0
    supersample: Annotated[int, within(1, 8, "rays per pixel side")] = 2


class MovingParams(BaseParams, frozen=True, kw_only=True):
    """Parameters of scenes in which something moves. motion_seed: draws a path, direction, start and speed (from 0.7 to
    1.4 times the one given); not given: the scene's own motion."""

    speed_m_per_s: Annotated[float, within(0.0, MAX_SPEED_M_PER_S, "mean speed of moving parts; 0 stands still")] = 1.0
    motion_seed: Annotated[int, within(0, math.inf, "draws another motion")] | None = None

    def __post_init__(self) -> None:
        if 0.0 < self.speed_m_per_s < 0.05:
            raise ValueError(f"speed_m_per_s must be 0 or at least 0.05, got {self.speed_m_per_s}")
