"""Joint speeds that bring the hand to a target: constraint-aware through pink, or by damped least squares.

Neither is what safety rests on: ``limits`` has the last word. What pink adds is that the arm slides along a
wall, or past itself, where damped least squares would be stopped short of it.
"""

from __future__ import annotations

import importlib.util
import logging
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from camera_node.robot.arm.capsules import ABOVE_FLOOR, PAIRS, Shape
from camera_node.robot.arm.kinematics import ArmModel
from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.settings import TeleopConfig
from freshfield.geometry import so3_log

log = logging.getLogger("camera-node.teleop")

Array = NDArray[np.float64]

# Damping turns the hand off its way, so there is none but near a singularity, where the Jacobian's least
# singular value falls below _NEAR (Maciejewski and Klein 1988).
_DAMPING, _NEAR = 0.05, 0.08
# Barriers stand so far inside of the limits: what slides along them is not stopped by the limits' last word.
_INSIDE_M = 0.003
# The share of the way to a barrier that may be made in a second. From the speed_m_s of the defaults it takes
# .5 m/s^2, which joints with their acceleration_rad_s2 have within the arm's reach.
_APPROACH_PER_S = 2.0
_PACKAGES = ("pink", "pinocchio", "coal", "daqp")


class Solver(Protocol):
    """failed: ticks for which it found no speeds."""

    name: str
    failed: int

    def speeds(self, q: Array, v: Array, target: Array) -> Array:
        """Joint speeds (6,) from joints and speeds (6,) towards base-from-flange ``target`` (4, 4)."""
        ...


def make_solver(arm: ArmModel, config: TeleopConfig) -> Solver:
    """The solver that a scenario asks for. Raises TeleopError where pink is asked for and not installed."""
    missing = [name for name in _PACKAGES if importlib.util.find_spec(name) is None]
    if config.solver == "dls" or (config.solver == "auto" and missing):
        return DampedLeastSquares(arm, config)
    if missing:
        raise TeleopError(
            f"solver: pink needs {', '.join(missing)}: pip install 'freshfield[teleop]', or set solver: dls"
        )
    return Pink(arm, config)


def twist(arm: ArmModel, q: Array, target: Array) -> Array:
    """What is left to go (6,) in base axes: metres, then a rotation vector."""
    now = arm.forward(q)
    return np.concatenate([target[:3, 3] - now[:3, 3], so3_log(target[:3, :3] @ now[:3, :3].T)])


def asked_twist(arm: ArmModel, q: Array, target: Array, config: TeleopConfig) -> Array:
    """Speed (6,) of the hand towards the target, no faster than its limit, so that its direction is kept."""
    wanted = config.gain_per_s * twist(arm, q, target)
    fastest = float(np.linalg.norm(wanted[:3]))
    return wanted * min(1.0, config.speed_m_s / fastest) if fastest > 0.0 else wanted


class DampedLeastSquares:
    """``v = J^T (J J^T + damping^2)^-1 twist`` (Wampler 1986), slowed where a joint would be too fast."""

    name = "dls"

    def __init__(self, arm: ArmModel, config: TeleopConfig) -> None:
        self._arm, self._config = arm, config
        self.failed = 0

    def speeds(self, q: Array, v: Array, target: Array) -> Array:
        """See ``Solver``."""
        del v
        wanted = asked_twist(self._arm, q, target, self._config)
        left, values, right = np.linalg.svd(self._arm.jacobian(q))
        damping = _DAMPING * max(0.0, 1.0 - (float(values[-1]) / _NEAR) ** 2)
        found: Array = right.T @ (values / (values**2 + damping**2) * (left.T @ wanted))
        fastest = float(np.abs(found).max())
        return found * min(1.0, self._config.speed_rad_s / fastest) if fastest > 0.0 else found


class Pink:
    """A quadratic program each tick (pink, on pinocchio): the hand's task under limits of joints and speed,
    with barriers at the workspace's walls and between the arm's parts."""

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
            self._model, self._model.createData(), np.zeros(6),
            collision_model=collisions, collision_data=collisions.createData(),
        )  # fmt: skip
        self._task = pink.tasks.FrameTask(
            "flange", position_cost=1.0, orientation_cost=0.3, lm_damping=1e-3, gain=1.0
        )
        # No limit of acceleration: together with a barrier that is already crossed by a hair it would leave
        # no solution. ``limits`` sees to it, and the barriers' gain is one that it can follow.
        self._limits = [ConfigurationLimit(self._model), VelocityLimit(self._model)]
        self._barriers = [
            PositionBarrier(
                "flange", p_min=np.array(config.workspace_low_m) + _INSIDE_M,
                p_max=np.array(config.workspace_high_m) - _INSIDE_M, gain=np.full(6, _APPROACH_PER_S),
            ),
            # Those nearest count: a barrier for each of the pairs would cost more than it gains. Without the
            # gain of 0 it would hold the arm back far from everything, too.
            SelfCollisionBarrier(
                8, gain=_APPROACH_PER_S, safe_displacement_gain=0.0, d_min=config.margin_m + _INSIDE_M
            ),
        ]  # fmt: skip
        self.failed = 0

    def speeds(self, q: Array, v: Array, target: Array) -> Array:
        """See ``Solver``; a stop where the program has no solution (counted)."""
        del v
        self._configuration.update(q)
        # The task makes the whole way in one tick: what it is given is how far one tick should come.
        step = asked_twist(self._arm, q, target, self._config) * self._dt_s
        now = self._arm.forward(q)
        goal = self._pin.SE3(self._pin.exp3(step[3:]) @ now[:3, :3], now[:3, 3] + step[:3])
        self._task.set_target(goal)
        try:
            found = self._pink.solve_ik(
                self._configuration, [self._task], self._dt_s, solver="daqp", damping=1e-6,
                limits=self._limits, barriers=self._barriers, safety_break=False,
            )  # fmt: skip
        except (self._pink.exceptions.PinkError, ValueError, ArithmeticError):
            found = None
        if found is None or not np.isfinite(found).all():
            self.failed += 1
            return np.zeros(6)
        return np.asarray(found, dtype=np.float64)


def _model(arm: ArmModel, config: TeleopConfig) -> tuple[Any, Any]:
    """The arm for pinocchio: its chain with limits, and its capsules with the pairs to keep apart."""
    import coal
    import pinocchio as pin

    model = pin.Model()
    parent, offset = 0, pin.SE3.Identity()
    margin = config.joint_margin_rad
    for i in range(6):
        placed = offset * pin.SE3(pin.utils.rotate("z", arm.theta_rad[i]), np.zeros(3))
        speed = min(config.speed_rad_s, arm.speed_rad_s[i])
        parent = model.addJoint(
            parent, pin.JointModelRZ(), placed, f"joint{i + 1}", np.full(1, 1e3), np.full(1, speed),
            np.full(1, arm.lower_rad[i] + margin), np.full(1, arm.upper_rad[i] - margin),
        )  # fmt: skip
        offset = pin.SE3(pin.utils.rotate("x", arm.alpha_rad[i]), np.array([arm.a_m[i], 0.0, arm.d_m[i]]))
    flange = pin.Frame("flange", parent, offset, pin.FrameType.OP_FRAME)
    model.addFrame(flange)

    shape = Shape(arm, config.tool_m, config.tool_radius_m)
    collisions = pin.GeometryModel()
    data, zero = model.createData(), np.zeros(6)
    pin.forwardKinematics(model, data, zero)
    a, b = shape.segments(arm.body.links(zero)[None])
    # The joint that moves each part, in the order of capsules.PARTS.
    moved_by = (0, 1, 2, 3, 4, 5, 6, 6)
    for k, (start, end, radius, joint) in enumerate(zip(a[0], b[0], shape.radii, moved_by)):
        along = end - start
        length = float(np.linalg.norm(along))
        turn = pin.Quaternion.FromTwoVectors(
            np.array([0.0, 0.0, 1.0]), along / length if length > 0 else np.array([0.0, 0.0, 1.0])
        )
        placed = data.oMi[joint].inverse() * pin.SE3(turn.matrix(), (start + end) / 2)
        # coal takes no capsule without length.
        body = coal.Capsule(float(radius), max(length, 1e-6))
        collisions.addGeometryObject(pin.GeometryObject(f"part{k}", joint, placed, body))
    # The barrier keeps margin_m from everything, the floor included; what is asked of the floor is floor_m.
    ground = coal.Halfspace(np.array([0.0, 0.0, 1.0]), config.floor_m - config.margin_m)
    floor = collisions.addGeometryObject(pin.GeometryObject("floor", 0, pin.SE3.Identity(), ground))
    for first, second in (*PAIRS, *((part, floor) for part in ABOVE_FLOOR)):
        collisions.addCollisionPair(pin.CollisionPair(first, second))
    return model, collisions
