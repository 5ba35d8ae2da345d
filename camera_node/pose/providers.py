"""What tells the poses of a camera, and a camera that does not move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from camera_node.pose.pairing import PoseGapError as PoseGapError
from freshfield.geometry import Pose


class PoseProvider(Protocol):
    def at(self, t_ns: int) -> tuple[Pose, int]:
        """The camera-to-world pose for an instant, and the time (ns) from that instant to the nearest sample.
        Raises PoseGapError if no sample is near enough."""
        ...


@runtime_checkable
class Closable(Protocol):
    """An object that holds a connection or device until ``close``."""

    def close(self) -> None: ...


@dataclass(frozen=True)
class FixedPose:
    """The pose of a camera that does not move."""

    pose: Pose

    def at(self, t_ns: int) -> tuple[Pose, int]:
        return self.pose, 0
