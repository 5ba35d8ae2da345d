"""The section ``source.arm`` of a scenario, with the tour of its camera and the limits of teleoperation."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from msgspec import Meta

from camera_node.node_constants import MAX_GAP_MS
from freshfield.settings import Settings, about, within

Elevation = Annotated[float, within(-89.0, 89.0, "elevations of the rings")]
Vector3 = tuple[float, float, float]
Roll = Annotated[float, within(-360.0, 360.0, "allowed rotations about the optical axis")]


class PathConfig(Settings, frozen=True):
    """The tour that ``camera-node drive-arm`` makes: viewpoints on rings around a target, looking at it.

    Azimuth 0 is on the target's -y side, 90 on its +x side. At each viewpoint the first rotation is used that the arm
    reaches.
    """

    target_m: Annotated[Vector3, about("target in the world")] = (0.0, 0.0, 0.0)
    radius_m: Annotated[float, within(1e-3, math.inf, "distance from camera to target")] = 0.35
    elevations_deg: Annotated[tuple[Elevation, ...], Meta(min_length=1)] = (45.0, 65.0)
    azimuths_deg: Annotated[tuple[float, float], about("first and last of each ring")] = (-90.0, 90.0)
    step_deg: Annotated[float, within(1.0, 120.0, "between viewpoints of a ring")] = 15.0
    rolls_deg: Annotated[tuple[Roll, ...], Meta(min_length=1)] = (0.0, 90.0, 180.0, 270.0)
    speed_rad_s: Annotated[float, within(1e-4, 3.14, "limit of the fastest joint")] = 0.5
    acceleration_rad_s2: Annotated[float, within(1e-4, 40.0, "limit of the fastest joint")] = 1.0
    floor_m: Annotated[float, about("least height (world z) of the joint centers beyond the shoulder")] = 0.05


class TeleopConfig(Settings, frozen=True):
    """How a stylus moves the arm. Positions are those of the flange, in the axes of the arm's base.

    The limits, from ``workspace_low_m`` on, hold at every tick, whatever the stylus does.
    """

    scale: Annotated[Vector3, about("S of (4.1): meters of the arm per meter of the stylus, along each axis")] = (
        1.0,
        1.0,
        1.0,
    )
    yaw_deg: Annotated[float, about("rotation of the stylus's axes about the vertical")] = 0.0
    orientation: Annotated[bool, about("whether the arm turns with the stylus")] = True
    rate_hz: Annotated[float, within(20.0, 500.0, "joint targets per second")] = 125.0
    gain_per_s: Annotated[float, within(0.1, 20.0, "commanded speed per distance from the target")] = 5.0
    filter_hz: Annotated[float, within(0.01, 1000.0, "cutoff of the one-euro filter at rest")] = 2.0
    filter_hz_s_m: Annotated[float, within(0.0, 1e4, "increase of the cutoff per m/s or rad/s")] = 20.0
    watchdog_ms: Annotated[float, within(10.0, 5000.0, "the arm stops if no message comes for so long")] = 200.0
    jump_m: Annotated[float, within(1e-3, 1.0, "a larger motion between two messages is a stylus put elsewhere")] = 0.05
    jump_rad: Annotated[float, within(1e-2, 3.14, "the same for rotations")] = 0.5
    workspace_low_m: Annotated[Vector3, about("corner of the box that the flange stays in")] = (-0.45, -0.45, 0.05)
    workspace_high_m: Annotated[Vector3, about("its opposite corner")] = (0.45, 0.45, 0.60)
    joint_margin_rad: Annotated[float, within(0.0, 3.0, "distance from the joints' limits")] = 0.05
    speed_rad_s: Annotated[float, within(1e-3, 6.28, "of every joint")] = 0.8
    acceleration_rad_s2: Annotated[float, within(0.05, 40.0, "of every joint")] = 2.0
    speed_m_s: Annotated[float, within(1e-3, 1.5, "of the flange")] = 0.25
    margin_m: Annotated[float, within(0.0, 0.2, "distance between parts of the arm that are not neighbors")] = 0.02
    floor_m: Annotated[float, within(-2.0, 1.0, "lowest height of the arm's parts beyond the shoulder")] = 0.0
    tool_m: Annotated[float, within(0.0, 0.5, "length of the camera and its mount, along the flange's axis")] = 0.08
    tool_radius_m: Annotated[float, within(1e-3, 0.2, "radius of the camera and its mount")] = 0.04

    def __post_init__(self) -> None:
        if not all(0.0 < abs(s) <= 100.0 for s in self.scale):
            raise ValueError("scale: expected three numbers within 100 that are not 0")
        if not all(low < high for low, high in zip(self.workspace_low_m, self.workspace_high_m)):
            raise ValueError("workspace_low_m must be below workspace_high_m along every axis")
        # The limiter checks every tick of a stop in advance, so stops must be short.
        if self.speed_rad_s / self.acceleration_rad_s2 > 2.0:
            raise ValueError("acceleration_rad_s2: too low to come to rest from speed_rad_s within 2 s")


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
    base_m: Annotated[Vector3, about("position of the arm's base in the world")] = (0.0, 0.0, 0.0)
    base_yaw_deg: Annotated[float, about("rotation of the arm's base about the vertical")] = 0.0
    frequency_hz: Annotated[float, within(10, 500, "joint states per second")] = 125.0
    pairing: Literal["nearest", "interpolated"] = "interpolated"
    max_gap_ms: Annotated[float, within(0, MAX_GAP_MS, "largest gap from frame to joint state")] = 20.0
    path: Annotated[PathConfig | None, about("the tour of camera-node drive-arm")] = None
    simulated: bool = False
    teleop: Annotated[TeleopConfig | None, about("limits and scale of camera-node teleop")] = None

    def __post_init__(self) -> None:
        if not self.cameras:
            raise ValueError("cameras: expected at least one camera with its hand-eye calibration")
        # drive-arm does not ask before it moves a simulated arm: a real one must not pass for one.
        if self.simulated and not self.host.startswith("127."):
            raise ValueError(f"simulated: host is {self.host}, expected one of this machine's, such as 127.0.0.2")
