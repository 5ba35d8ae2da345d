"""The section ``source.arm`` of a scenario, with the tour of its camera; that of teleoperation stands in ``teleop``."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from msgspec import Meta

from camera_node.node_constants import MAX_GAP_MS
from freshfield.settings import Settings, about, within

Elevation = Annotated[float, within(-89.0, 89.0, "elevations of the rings")]
Roll = Annotated[float, within(-360.0, 360.0, "allowed rotations about the optical axis")]


class PathConfig(Settings, frozen=True):
    """The tour that ``camera-node drive-arm`` makes: viewpoints on rings around a target, looking at it.

    Azimuth 0 is on the target's -y side, 90 on its +x side. At each viewpoint the first rotation is used that the arm
    reaches.
    """

    target_m: Annotated[tuple[float, float, float], about("target in the world")] = (0.0, 0.0, 0.0)
    radius_m: Annotated[float, within(1e-3, math.inf, "distance from camera to target")] = 0.35
    elevations_deg: Annotated[tuple[Elevation, ...], Meta(min_length=1)] = (45.0, 65.0)
    azimuths_deg: Annotated[tuple[float, float], about("first and last of each ring")] = (-90.0, 90.0)
    step_deg: Annotated[float, within(1.0, 120.0, "between viewpoints of a ring")] = 15.0
    rolls_deg: Annotated[tuple[Roll, ...], Meta(min_length=1)] = (0.0, 90.0, 180.0, 270.0)
    speed_rad_s: Annotated[float, within(1e-4, 3.14, "limit of the fastest joint")] = 0.5
    acceleration_rad_s2: Annotated[float, within(1e-4, 40.0, "limit of the fastest joint")] = 1.0
    floor_m: Annotated[float, about("least height (world z) of the joint centers beyond the shoulder")] = 0.05


class ArmConfig(Settings, frozen=True):
    """An arm whose joint states give cameras their poses (extra ``ur``).

    cameras: files of ``camera-node calibrate hand-eye``, relative to the scenario; null before calibration: poses are
    then those of the flange, as that command needs them.
    simulated: the launcher starts ``camera-node simulate-arm`` at ``host`` (an address of this machine, 127.0.0.2 and
    up) and drives it.
    """

    host: Annotated[str, about("the controller's address")]
    cameras: Annotated[dict[str, str | None], about("camera -> its hand-eye calibration")]
    robot: Literal["ur3e"] = "ur3e"
    calibration: Annotated[str | None, about("the robot's own calibration.conf, relative to the scenario")] = None
    base_m: Annotated[tuple[float, float, float], about("position of the arm's base in the world")] = (0.0, 0.0, 0.0)
    base_yaw_deg: Annotated[float, about("rotation of the arm's base about the vertical")] = 0.0
    frequency_hz: Annotated[float, within(10, 500, "joint states per second")] = 125.0
    pairing: Literal["nearest", "interpolated"] = "interpolated"
    max_gap_ms: Annotated[float, within(0, MAX_GAP_MS, "largest gap from frame to joint state")] = 20.0
    path: Annotated[PathConfig | None, about("the tour of camera-node drive-arm")] = None
    simulated: bool = False
    teleop: Annotated[dict[str, Any] | None, about("keys for camera-node teleop")] = None  # read by that command alone

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("cameras: expected at least one camera with its hand-eye calibration")
        # drive-arm does not ask before it moves a simulated arm: a real one must not pass for one.
        if self.simulated and not self.host.startswith("127."):
            raise ValueError(f"simulated: host is {self.host}, expected one of this machine's, such as 127.0.0.2")
