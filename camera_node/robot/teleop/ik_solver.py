"""Differential inverse kinematics: joint speeds towards a target, by pink (constraint-aware) or damped least
squares.

Safety does not depend on the solver: ``limits`` checks every result. With pink the arm slides along a wall or
past its own parts; with damped least squares it stops there.
"""

from __future__ import annotations

import importlib.util
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.robot.arm.capsules import ABOVE_FLOOR, PAIRS, CapsuleModel
from camera_node.robot.arm.kinematics import ArmModel, pose_difference
from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.settings import TeleopConfig

Array = NDArray[np.float64]

# Damping distorts the hand's direction, so it is applied only near a singularity, where the Jacobian's least
# singular value falls below _DAMPING_THRESHOLD (Maciejewski and Klein 1988).
_DAMPING, _DAMPING_THRESHOLD = 0.05, 0.08
# Barriers lie this far inside the limits, so that an arm sliding along them is not stopped by the limits.
_BARRIER_INSET_M = 0.003
# Share of the distance to a barrier that may be covered in a second. At the default speed_m_s this needs
# 0.5 m/s^2, which joints with the default acceleration_rad_s2 have within the arm's reach.
_BARRIER_GAIN_PER_S = 2.0
_PACKAGES = ("pink", "pinocchio", "coal", "daqp")


def make_solver(arm: ArmModel, config: TeleopConfig) -> DampedLeastSquares | PinkSolver:
    """The solver named in a scenario. Raises TeleopError if it is pink and not installed."""
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if config.solver == "dls" or (config.solver == "auto" and missing):
        return DampedLeastSquares(arm, config)
    if missing:
        raise TeleopError(
            f"solver: pink needs {', '.join(missing)}: pip install 'freshfield[teleop]', or set solver: dls"
        )
    return PinkSolver(arm, config)


def commanded_twist(arm: ArmModel, q: Array, target: Array, config: TeleopConfig) -> Array:
    """Speed (6,) of the hand towards the target, in m/s and rad/s, scaled down to its speed limit."""
    wanted = config.gain_per_s * pose_difference(arm.forward(q), target)
    fastest = float(np.linalg.norm(wanted[:3]))
    return wanted * min(1.0, config.speed_m_s / fastest) if fastest > 0.0 else wanted


class DampedLeastSquares:
    """``v = J^T (J J^T + damping^2)^-1 twist`` (Wampler 1986), scaled down to the joints' speed limit.

    failed: number of ticks without a solution.
    """

    name = "dls"

    def __init__(self, arm: ArmModel, config: TeleopConfig) -> None:
        self._arm, self._config = arm, config
        self.failed = 0

    def speeds(self, q: Array, target: Array) -> Array:
        """Joint speeds (6,), rad/s, from joints ``q`` (6,) towards ``target``, base-from-flange (4, 4)."""
        wanted = commanded_twist(self._arm, q, target, self._config)
        left, values, right = np.linalg.svd(self._arm.jacobian(q))
        damping = _DAMPING * max(0.0, 1.0 - (float(values[-1]) / _DAMPING_THRESHOLD) ** 2)
        found: Array = right.T @ (values / (values**2 + damping**2) * (left.T @ wanted))
        fastest = float(np.abs(found).max())
        return found * min(1.0, self._config.speed_rad_s / fastest) if fastest > 0.0 else found


class PinkSolver:
    """One quadratic program per tick (pink, on pinocchio): follow the target within limits of joints and
    speed, with barriers at the workspace's walls and between the arm's parts."""

    name = "pink"

    def __init__(self, arm: ArmModel, config: TeleopConfig) -> None:
        import pink
        import pinocchio as pin
        from pink.barriers import PositionBarrier, SelfCollisionBarrier
        from pink.limits import ConfigurationLimit, VelocityLimit

        self._pink, self._pin = pink, pin
        self._config, self._dt_s = config, 1.0 / config.rate_hz
        self._arm = arm
        self._model, collisions = _model(arm, config)
        self._configuration: Any = pink.Configuration(
            self._model,
            self._model.createData(),
            np.zeros(6),
            collision_model=collisions,
            collision_data=collisions.createData(),
        )
        self._task = pink.tasks.FrameTask("flange", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-3, gain=1.0)
        # No acceleration limit: with a barrier that is already slightly crossed it would leave no solution.
        # ``limits`` enforces acceleration, and the barriers' gain is low enough for it.
        self._limits = [ConfigurationLimit(self._model), VelocityLimit(self._model)]
        self._barriers = [
            PositionBarrier(
                "flange",
                p_min=np.array(config.workspace_low_m) + _BARRIER_INSET_M,
                p_max=np.array(config.workspace_high_m) - _BARRIER_INSET_M,
                gain=np.full(6, _BARRIER_GAIN_PER_S),
            ),
            # Only the nearest pairs: a barrier for every pair would cost more than it gains. A safe
            # displacement gain above 0 would hold the arm back even far from everything.
            SelfCollisionBarrier(
                8, gain=_BARRIER_GAIN_PER_S, safe_displacement_gain=0.0, d_min=config.margin_m + _BARRIER_INSET_M
            ),
        ]
        self.failed = 0

    def speeds(self, q: Array, target: Array) -> Array:
        """See ``DampedLeastSquares``. Zero if the program has no solution (counted)."""
        self._configuration.update(q)
        # The task tries to reach its target in one tick, so the target is one tick's step away.
        step = commanded_twist(self._arm, q, target, self._config) * self._dt_s
        now = self._arm.forward(q)
        goal = self._pin.SE3(self._pin.exp3(step[3:]) @ now[:3, :3], now[:3, 3] + step[:3])
        self._task.set_target(goal)
        try:
            found = self._pink.solve_ik(
                self._configuration,
                [self._task],
                self._dt_s,
                solver="daqp",
                damping=1e-6,
                limits=self._limits,
                barriers=self._barriers,
                safety_break=False,
            )
        except (self._pink.exceptions.PinkError, ValueError, ArithmeticError):
            found = None
        if found is None or not np.isfinite(found).all():
            self.failed += 1
            return np.zeros(6)
        return np.asarray(found, dtype=np.float64)


def _model(arm: ArmModel, config: TeleopConfig) -> tuple[Any, Any]:
    """The arm as pinocchio's models: its joints with limits, and its capsules with the pairs to keep
    apart."""
    import coal
    import pinocchio as pin

    model = pin.Model()
    parent, offset = 0, pin.SE3.Identity()
    margin = config.joint_margin_rad
    for i in range(6):
        placed = offset * pin.SE3(pin.utils.rotate("z", arm.theta_rad[i]), np.zeros(3))
        speed = min(config.speed_rad_s, arm.speed_rad_s[i])
        parent = model.addJoint(
            parent,
            pin.JointModelRZ(),
            placed,
            f"joint{i + 1}",
            np.full(1, 1e3),
            np.full(1, speed),
            np.full(1, arm.lower_rad[i] + margin),
            np.full(1, arm.upper_rad[i] - margin),
        )
        offset = pin.SE3(pin.utils.rotate("x", arm.alpha_rad[i]), np.array([arm.a_m[i], 0.0, arm.d_m[i]]))
    flange = pin.Frame("flange", parent, offset, pin.FrameType.OP_FRAME)
    model.addFrame(flange)

    shape = CapsuleModel(arm, config.tool_m, config.tool_radius_m)
    collisions = pin.GeometryModel()
    data, zero = model.createData(), np.zeros(6)
    pin.forwardKinematics(model, data, zero)
    a, b = shape.segments(arm.nominal_model.link_frames(zero)[None])
    # The joint that moves each part, in the order of capsules.PARTS.
    moved_by = (0, 1, 2, 3, 4, 5, 6, 6)
    for k, (start, end, radius, joint) in enumerate(zip(a[0], b[0], shape.radii, moved_by)):
        along = end - start
        length = float(np.linalg.norm(along))
        turn = pin.Quaternion.FromTwoVectors(
            np.array([0.0, 0.0, 1.0]), along / length if length > 0 else np.array([0.0, 0.0, 1.0])
        )
        placed = data.oMi[joint].inverse() * pin.SE3(turn.matrix(), (start + end) / 2)
        # coal accepts no capsule of length 0.
        body = coal.Capsule(float(radius), max(length, 1e-6))
        collisions.addGeometryObject(pin.GeometryObject(f"part{k}", joint, placed, body))
    # The barrier keeps margin_m from everything, so the floor is lowered by it to leave floor_m.
    ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), config.floor_m - config.margin_m)
    floor = collisions.addGeometryObject(pin.GeometryObject("floor", 0, pin.SE3.Identity(), ground))
    for first, second in (*PAIRS, *((part, floor) for part in ABOVE_FLOOR)):
        collisions.addCollisionPair(pin.CollisionPair(first, second))
    return model, collisions
