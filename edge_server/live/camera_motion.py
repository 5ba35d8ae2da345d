"""Detects camera motion from the poses that frames report.

Pose noise, a single wrong pose, and a camera that is knocked or recalibrated (and then stands still elsewhere) do not
count as motion. So a camera moves if it has left its place twice, each time by more than ``APART_M`` or
``APART_DEG``, in two consecutive frames.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.live import live_constants as tuned


def pose_distance(a: NDArray[np.float64], b: NDArray[np.float64]) -> tuple[float, float]:
    """Distance in meters and angle in degrees of two poses, camera to world (4, 4)."""
    apart_m = float(np.linalg.norm(a[:3, 3] - b[:3, 3]))
    cosine = (np.trace(a[:3, :3].T @ b[:3, :3]) - 1.0) / 2.0
    return apart_m, float(np.rad2deg(np.arccos(np.clip(cosine, -1.0, 1.0))))


@dataclass
class _Place:
    """Where a camera stands, the instant of its newest frame, how many frames in a row were taken elsewhere,
    and how many places it has left."""

    pose: NDArray[np.float64]
    newest_ns: int
    away: int = 0
    left: int = 0


class CameraMotion:
    """Tracks the poses of all cameras; memory is one pose per camera."""

    def __init__(self) -> None:
        self._places: dict[str, _Place] = {}

    def moving(self, views: Iterable[View]) -> str | None:
        """Process the poses of views, each camera's in the order of capture (older ones are ignored). Returns
        a camera that moves; None while none is known to."""
        for view in views:
            place = self._places.get(view.camera)
            if place is None:
                self._places[view.camera] = _Place(view.camera_to_world, view.generated_ns)
            elif view.generated_ns > place.newest_ns and self._leaves(place, view):
                return view.camera
        return None

    @staticmethod
    def _leaves(place: _Place, view: View) -> bool:
        """Whether the camera has now left as many places as one that moves."""
        place.newest_ns = view.generated_ns
        if np.array_equal(place.pose, view.camera_to_world):  # most cameras; quicker than a distance
            place.away = 0
            return False
        apart_m, apart_deg = pose_distance(place.pose, view.camera_to_world)
        place.away = place.away + 1 if apart_m > tuned.APART_M or apart_deg > tuned.APART_DEG else 0
        if place.away == tuned.IN_A_ROW:
            place.pose, place.away, place.left = view.camera_to_world, 0, place.left + 1
        return place.left >= tuned.MOVES
