"""Joint speeds that move the flange towards a target, damped near singularities."""

from __future__ import annotations

import numpy as np

from camera_node.robot.arm.kinematics import ArmModel, pose_difference
from camera_node.robot.arm.settings import TeleopConfig
from camera_node.robot.teleop import teleop_constants as tuned
from freshfield.geometry import Array


def joint_speeds(arm: ArmModel, config: TeleopConfig, q: Array, target: Array) -> Array:
    """Joint speeds (6,), rad/s, from joints ``q`` (6,) towards ``target``, base-from-flange (4, 4):
    ``v = J^T (J J^T + damping^2)^-1 twist`` (Wampler 1986), scaled down to the joints' speed limit."""
    left, values, right = np.linalg.svd(arm.jacobian(q))
    damping = tuned.DAMPING * max(0.0, 1.0 - (float(values[-1]) / tuned.DAMPING_THRESHOLD) ** 2)
    wanted = commanded_twist(arm, config, q, target)
    found: Array = right.T @ (values / (values**2 + damping**2) * (left.T @ wanted))
    fastest = float(np.abs(found).max())
    return found * min(1.0, config.speed_rad_s / fastest) if fastest > 0.0 else found


def commanded_twist(arm: ArmModel, config: TeleopConfig, q: Array, target: Array) -> Array:
    """Speed (6,) of the flange towards the target, in m/s and rad/s, scaled down to its speed limit."""
    wanted = config.gain_per_s * pose_difference(arm.forward(q), target)
    fastest = float(np.linalg.norm(wanted[:3]))
    return wanted * min(1.0, config.speed_m_s / fastest) if fastest > 0.0 else wanted
