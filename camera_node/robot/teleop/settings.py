"""The section ``source.arm.teleop`` of a scenario."""

from __future__ import annotations

from dataclasses import dataclass

from camera_node.bounds import Bounded, bounded

Vector3 = tuple[float, float, float]


@dataclass(frozen=True)
class TeleopConfig(Bounded):
    """How a stylus moves the arm. Positions are those of the flange, in the axes of the arm's base.

    scale: S of (4.1): meters of the arm per meter of the stylus, along each axis of the base.
    yaw_deg: rotation of the stylus's axes about the vertical.
    orientation: whether the arm turns with the stylus.
    rate_hz: joint targets per second, 20 to 500.
    gain_per_s: the commanded speed per distance from the target.
    filter_hz, filter_hz_s_m: cutoff of the one-euro filter at rest, and its increase per m/s (or rad/s).
    watchdog_ms: the arm stops if no message comes for so long.
    jump_m, jump_rad: a larger motion between two messages counts as a stylus put elsewhere.

    The following limits hold at every tick, whatever the stylus does.

    workspace_low_m, workspace_high_m: corners of the box that the flange stays in.
    joint_margin_rad: distance from the joints' limits.
    speed_rad_s, acceleration_rad_s2: of every joint; speed_m_s: of the flange.
    margin_m: distance between parts of the arm that are not neighbors.
    floor_m: lowest height of the arm's parts beyond the shoulder.
    tool_m, tool_radius_m: the camera and its mount, as a capsule along the flange's axis.
    """

    scale: Vector3 = (1.0, 1.0, 1.0)
    yaw_deg: float = 0.0
    orientation: bool = True
    rate_hz: float = bounded(125.0, 20.0, 500.0)
    gain_per_s: float = bounded(5.0, 0.1, 20.0)
    filter_hz: float = bounded(2.0, 0.01, 1000.0)
    filter_hz_s_m: float = bounded(20.0, 0.0, 1e4)
    watchdog_ms: float = bounded(200.0, 10.0, 5000.0)
    jump_m: float = bounded(0.05, 1e-3, 1.0)
    jump_rad: float = bounded(0.5, 1e-2, 3.14)
    workspace_low_m: Vector3 = (-0.45, -0.45, 0.05)
    workspace_high_m: Vector3 = (0.45, 0.45, 0.60)
    joint_margin_rad: float = bounded(0.05, 0.0, 3.0)
    speed_rad_s: float = bounded(0.8, 1e-3, 6.28)
    acceleration_rad_s2: float = bounded(2.0, 0.05, 40.0)
    speed_m_s: float = bounded(0.25, 1e-3, 1.5)
    margin_m: float = bounded(0.02, 0.0, 0.2)
    floor_m: float = bounded(0.0, -2.0, 1.0)
    tool_m: float = bounded(0.08, 0.0, 0.5)
    tool_radius_m: float = bounded(0.04, 1e-3, 0.2)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not all(0.0 < abs(s) <= 100.0 for s in self.scale):
            raise ValueError("scale: expected three numbers within 100 that are not 0")
        if not all(low < high for low, high in zip(self.workspace_low_m, self.workspace_high_m)):
            raise ValueError("workspace_low_m must be below workspace_high_m along every axis")
        # The limiter checks every tick of a stop in advance, so stops must be short.
        if self.speed_rad_s / self.acceleration_rad_s2 > 2.0:
            raise ValueError("acceleration_rad_s2: too low to come to rest from speed_rad_s within 2 s")
