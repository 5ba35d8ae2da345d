"""What must hold of every tick, computed by other means than the limiter's own."""

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from camera_node.robot.arm.capsules import CapsuleModel
from camera_node.robot.arm.kinematics import UR3E
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.robot.teleop.settings import TeleopConfig
from camera_node.robot.teleop.stylus import StylusSample
from camera_node.robot.teleop.teleoperator import Command, Teleoperator

HOME = np.array(HOME_RAD)
EPS = 1e-9


def sample(t_ns: int, position: Sequence[float] = (0.0, 0.0, 0.0), clutch: bool = True) -> StylusSample:
    x, y, z = position
    return StylusSample(t_ns, (x, y, z), (1.0, 0.0, 0.0, 0.0), clutch)


def drive(operator: Teleoperator, ticks: Iterable[tuple[int, Sequence[StylusSample]]]) -> list[Command]:
    """The commands of (now_ns, samples) after one another."""
    return [operator.tick(now_ns, samples) for now_ns, samples in ticks]


def assert_within_limits(config: TeleopConfig, commands: Sequence[Command], start: NDArray[np.float64] = HOME) -> None:
    """Every limit of ``config`` at every tick, from the joints alone: speeds and accelerations are their
    differences."""
    dt_s = 1.0 / config.rate_hz
    q = np.concatenate([start[None], [c.joints for c in commands]])
    assert np.isfinite(q).all()
    low, high = np.array(UR3E.lower_rad), np.array(UR3E.upper_rad)
    assert (q >= low + config.joint_margin_rad - EPS).all()
    assert (q <= high - config.joint_margin_rad + EPS).all()
    speeds = np.diff(q, axis=0) / dt_s
    # Differences of joints lose digits: 1e-15 rad over a tick is 1e-13 rad/s, over its square 1e-11 rad/s^2.
    assert np.abs(speeds).max() <= config.speed_rad_s + EPS
    accelerations = np.diff(np.concatenate([np.zeros((1, 6)), speeds]), axis=0) / dt_s
    assert np.abs(accelerations).max() <= config.acceleration_rad_s2 + 1e-7
    flange = np.array([UR3E.forward(each)[:3, 3] for each in q])
    assert (flange >= np.array(config.workspace_low_m) - EPS).all()
    assert (flange <= np.array(config.workspace_high_m) + EPS).all()
    fastest = np.linalg.norm(np.diff(flange, axis=0), axis=1).max() / dt_s
    assert fastest <= config.speed_m_s + EPS
    apart, lowest = CapsuleModel(UR3E, config.tool_m, config.tool_radius_m).clearance(UR3E.link_frames(q))
    assert apart.min() >= config.margin_m - EPS
    assert lowest.min() >= config.floor_m - EPS
