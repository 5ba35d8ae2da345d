"""Where an arm's hand is for given joint angles, and which angles bring it somewhere (thesis 4.2.1).

A six-axis arm of Universal Robots' make as a chain of standard Denavit-Hartenberg links,
``T_{i-1}^i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)``. Forward it is the product of six links. Backward
there are up to eight postures, found in closed form (Hawkins 2013, "Analytic inverse kinematics for the
Universal Robots UR-5/UR-10 arms"); an arm with its own calibration is not exactly such a chain, and each
posture is then refined by damped least squares.

The arm loses a direction of motion where the Jacobian's determinant vanishes; for these arms it is
``a2 a3 sin(q5) sin(q3) (a2 cos(q2) + a3 cos(q2 + q3) + d5 sin(q2 + q3 + q4))`` up to its sign, whose three
factors are the wrist, the elbow and the shoulder singularity.
"""

from __future__ import annotations

import configparser
import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from freshfield.geometry import se3_inverse, so3_log

Array = NDArray[np.float64]
Six = tuple[float, float, float, float, float, float]

_ZERO: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# A target out of reach by no more than rounding is taken as at the edge of it.
_EDGE = 1e-9
# Where sin(q5) is smaller, rounding alone decides q6: it is free, and chosen.
_FREE = 1e-9
_REACHED_M = 1e-7
_REACHED_RAD = 1e-7
SINGULAR_SIN = math.sin(math.radians(5.0))
SINGULAR_M = 0.02


class KinematicsError(ValueError):
    """A calibration or joint vector that no arm can have; the message says which part and why."""


@dataclass(frozen=True)
class ArmModel:
    """One arm's links and limits. d_m, a_m: metres; alpha_rad, theta_rad (added to each joint's angle):
    radians; lower_rad, upper_rad: joint limits; speed_rad_s: the fastest each joint turns."""

    name: str
    d_m: Six
    a_m: Six
    alpha_rad: Six
    theta_rad: Six = _ZERO
    lower_rad: Six = (-2 * math.pi,) * 6  # type: ignore[assignment]
    upper_rad: Six = (2 * math.pi,) * 6  # type: ignore[assignment]
    speed_rad_s: Six = (math.pi,) * 3 + (2 * math.pi,) * 3  # type: ignore[assignment]
    nominal: ArmModel | None = None
    """The uncalibrated model that the closed form is solved for; None: this one."""

    @property
    def body(self) -> ArmModel:
        """The model whose link frames lie within the arm's parts, as distances need them. A calibrated one's
        do not: the factory's fit puts metres into lengths along parallel axes, which all but cancel at the
        flange, so that the elbow's frame may lie in the next room."""
        return self.nominal or self

    def links(self, joints: ArrayLike) -> Array:
        """Base-from-link transforms (7, 4, 4) of joint angles (6,) in radians: the base itself, then each
        link's frame; the last one is the flange. For where its parts are, ask ``body``. Raises
        KinematicsError for angles that are not finite."""
        q = _joints(joints)
        out = np.empty((7, 4, 4))
        out[0] = np.eye(4)
        for i in range(6):
            out[i + 1] = out[i] @ _link(
                float(q[i]) + self.theta_rad[i], self.d_m[i], self.a_m[i], self.alpha_rad[i]
            )
        return out

    def forward(self, joints: ArrayLike) -> Array:
        """Base-from-flange transform (4, 4) of joint angles (6,) in radians (thesis 4.1)."""
        flange: Array = self.links(joints)[6]
        return flange

    def jacobian(self, joints: ArrayLike) -> Array:
        """Geometric Jacobian (6, 6) at the flange in base axes: rows are linear (m/rad), then angular."""
        links = self.links(joints)
        axes = links[:6, :3, 2]
        arms = links[6, :3, 3] - links[:6, :3, 3]
        return np.concatenate([np.cross(axes, arms).T, axes.T])

    def singularities(self, joints: ArrayLike) -> tuple[str, ...]:
        """Those of ``shoulder``, ``elbow`` and ``wrist`` that a posture is near: within 5 degrees for the
        elbow and the wrist, with the wrist's centre within 2 cm of above the base for the shoulder."""
        factors = self.singularity_factors(joints)
        limits = (SINGULAR_M, SINGULAR_SIN, SINGULAR_SIN)
        names = ("shoulder", "elbow", "wrist")
        return tuple(name for name, f, limit in zip(names, factors, limits) if abs(f) < limit)

    def singularity_factors(self, joints: ArrayLike) -> tuple[float, float, float]:
        """What vanishes at the shoulder (metres), elbow and wrist (sines) singularity."""
        base = self.nominal or self
        q = _joints(joints)
        reach = (
            base.a_m[1] * math.cos(q[1])
            + base.a_m[2] * math.cos(q[1] + q[2])
            + base.d_m[4] * math.sin(q[1] + q[2] + q[3])
        )
        return reach, math.sin(q[2]), math.sin(q[4])

    def inverse(self, target: ArrayLike, near: ArrayLike | None = None) -> list[Posture]:
        """All postures, at most eight, that bring the flange to ``target``, base-from-flange (4, 4).

        near: joint angles (6,); postures are turned by whole turns to be nearest to them within the limits,
        and come nearest first. Where the wrist is singular, joint 6 keeps ``near``'s angle (else 0) and joint
        4 makes up for it. An empty list: out of reach, or only beyond the limits.
        """
        wanted = np.asarray(target, dtype=np.float64)
        if wanted.shape != (4, 4) or not np.all(np.isfinite(wanted)):
            raise KinematicsError("the target must be a finite 4 x 4 matrix")
        start = np.zeros(6) if near is None else _joints(near)
        base = self.nominal or self
        found: list[Posture] = []
        for q in _closed_form(base, wanted, float(start[5])):
            solution: Array | None = q
            if self.nominal is not None:
                solution = self.refine(wanted, q)
            elif not _reaches(self.forward(q), wanted):
                solution = None
            placed = None if solution is None else self._turned(solution, start)
            if placed is None or any(np.abs(placed - p.joints).max() < 1e-7 for p in found):
                continue
            found.append(Posture(placed, self.singularities(placed)))
        if near is not None:
            found.sort(key=lambda p: float(np.abs(p.joints - start).max()))
        return found

    def refine(self, target: ArrayLike, start: ArrayLike, rounds: int = 50) -> Array | None:
        """The posture (6,) near ``start`` that brings the flange to ``target``, by damped least squares
        (Levenberg-Marquardt); None where it does not get within 1e-7 m and rad."""
        wanted, q = np.asarray(target, dtype=np.float64), _joints(start).copy()
        error = _twist(self.forward(q), wanted)
        damping = 1e-6
        for _ in range(rounds):
            if np.abs(error).max() < 1e-12:
                break
            j = self.jacobian(q)
            step = np.linalg.solve(j.T @ j + damping * np.eye(6), j.T @ error)
            tried = q + step
            after = _twist(self.forward(tried), wanted)
            if np.linalg.norm(after) < np.linalg.norm(error):
                q, error, damping = tried, after, max(damping * 0.1, 1e-12)
            else:
                damping *= 10.0
                if damping > 1e6:
                    break
        return q if _reaches(self.forward(q), wanted) else None

    def _turned(self, joints: Array, near: Array) -> Array | None:
        """``joints`` by whole turns as near to ``near`` as the limits allow; None if they do not."""
        low, high = np.array(self.lower_rad), np.array(self.upper_rad)
        turn = 2 * math.pi
        q = joints + turn * np.round((near - joints) / turn)
        q = np.where(q > high, q - turn * np.ceil((q - high) / turn), q)
        q = np.where(q < low, q + turn * np.ceil((low - q) / turn), q)
        return q if np.all((q >= low - _EDGE) & (q <= high + _EDGE)) else None


@dataclass(frozen=True)
class Posture:
    """One solution of the inverse. joints: (6,) radians. singular: see ``ArmModel.singularities``."""

    joints: Array
    singular: tuple[str, ...]


# Universal Robots' data sheet (https://www.universal-robots.com/articles/ur/application-installation/
# dh-parameters-for-calculations-of-kinematics-and-dynamics/).
UR3E = ArmModel(
    name="ur3e",
    d_m=(0.15185, 0.0, 0.0, 0.13105, 0.08535, 0.0921),
    a_m=(0.0, -0.24355, -0.2132, 0.0, 0.0, 0.0),
    alpha_rad=(math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0),
)
MODELS = {UR3E.name: UR3E}


def calibrated(model: ArmModel, file: Path) -> ArmModel:
    """``model`` with one robot's own deviations, measured at the factory, from its ``calibration.conf``.

    The file lies on the controller, in ``/root/.urcontrol/``; it is an INI file whose section ``mounting``
    has ``delta_theta``, ``delta_a``, ``delta_d`` and ``delta_alpha``, each a list of six numbers (radians and
    metres) that are added to the data sheet's Denavit-Hartenberg parameters. A list that is missing is zero;
    a file with none of them is refused. Raises KinematicsError.
    """
    parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"), interpolation=None, strict=False)
    try:
        parser.read_string(file.read_text())
    except (OSError, UnicodeDecodeError, configparser.Error) as error:
        raise KinematicsError(f"{file}: cannot be read: {' '.join(str(error).split())}") from None
    deltas: dict[str, Six] = {}
    for section in parser.sections():
        for key in ("theta", "a", "d", "alpha"):
            if f"delta_{key}" in parser[section]:
                where = f"{file}: [{section}] delta_{key}"
                deltas[key] = _six(parser[section][f"delta_{key}"], where)
    if not deltas:
        raise KinematicsError(f"{file}: has no delta_theta, delta_a, delta_d or delta_alpha")

    def moved(values: Sequence[float], key: str) -> Six:
        return tuple(v + x for v, x in zip(values, deltas.get(key, _ZERO)))  # type: ignore[return-value]

    return dataclasses.replace(
        model,
        name=f"{model.name} ({file.name})",
        d_m=moved(model.d_m, "d"),
        a_m=moved(model.a_m, "a"),
        alpha_rad=moved(model.alpha_rad, "alpha"),
        theta_rad=moved(model.theta_rad, "theta"),
        nominal=model.nominal or model,
    )


def _closed_form(arm: ArmModel, target: Array, free_rad: float) -> list[Array]:
    """Joint angles (6,) of every posture of an uncalibrated arm; ``free_rad`` is joint 6 where it is free."""
    (d1, _, _, d4, d5, d6), (_, a2, a3, *_) = arm.d_m, arm.a_m
    r = target[:3, :3]
    wrist = target[:3, 3] - d6 * r[:, 2]
    out = math.hypot(wrist[0], wrist[1])
    if out < d4 - _EDGE:
        return []  # inside the cylinder that the forearm's offset keeps free
    around = math.acos(min(1.0, d4 / out))
    postures = []
    for q1 in {math.atan2(wrist[1], wrist[0]) + s * around + math.pi / 2 for s in (1.0, -1.0)}:
        s1, c1 = math.sin(q1), math.cos(q1)
        # sin(q5) from its two components, not from the cosine: exact where the wrist is straight.
        x6, y6 = r[0, 0] * s1 - r[1, 0] * c1, r[1, 1] * c1 - r[0, 1] * s1
        sin5, cos5 = math.hypot(x6, y6), r[0, 2] * s1 - r[1, 2] * c1
        for sign in (1.0, -1.0):
            q5 = math.atan2(sign * sin5, cos5)
            q6 = free_rad if sin5 < _FREE else math.atan2(sign * y6, sign * x6)
            first = _link(q1, d1, 0.0, math.pi / 2)
            last = _link(q5, d5, 0.0, -math.pi / 2) @ _link(q6, d6, 0.0, 0.0)
            middle = se3_inverse(first) @ target @ se3_inverse(last)
            x, y = (middle[:3, 3] - d4 * middle[:3, 1])[:2]
            cos3 = (x * x + y * y - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
            if abs(cos3) > 1.0 + _EDGE:
                continue  # farther than the stretched arm reaches, or nearer than the folded one
            for bend in (1.0, -1.0):
                q3 = bend * math.acos(max(-1.0, min(1.0, cos3)))
                q2 = math.atan2(y, x) - math.atan2(a3 * math.sin(q3), a2 + a3 * math.cos(q3))
                elbow = _link(q2, 0.0, a2, 0.0) @ _link(q3, 0.0, a3, 0.0)
                turned = elbow[:3, :3].T @ middle[:3, :3]
                q4 = math.atan2(turned[1, 0], turned[0, 0])
                postures.append(_wrapped(np.array([q1, q2, q3, q4, q5, q6])))
    return postures


def _link(theta: float, d: float, a: float, alpha: float) -> Array:
    """Rz(theta) Tz(d) Tx(a) Rx(alpha), (4, 4)."""
    ct, st, ca, sa = math.cos(theta), math.sin(theta), math.cos(alpha), math.sin(alpha)
    return np.array(
        [
            [ct, -st * ca, st * sa, a * ct],
            [st, ct * ca, -ct * sa, a * st],
            [0.0, sa, ca, d],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _twist(now: Array, wanted: Array) -> Array:
    """What is left to go (6,), in base axes: metres, then a rotation vector in radians."""
    return np.concatenate([wanted[:3, 3] - now[:3, 3], so3_log(wanted[:3, :3] @ now[:3, :3].T)])


def _reaches(now: Array, wanted: Array) -> bool:
    left = np.abs(_twist(now, wanted))
    return bool(left[:3].max() < _REACHED_M and left[3:].max() < _REACHED_RAD)


def _wrapped(q: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (q + math.pi) % (2 * math.pi) - math.pi


def _joints(values: ArrayLike) -> Array:
    q = np.asarray(values, dtype=np.float64)
    if q.shape != (6,) or not np.all(np.isfinite(q)):
        raise KinematicsError(f"expected six finite joint angles, got {values!r}")
    return q


def _six(text: str, where: str) -> Six:
    try:
        values = [float(v) for v in json.loads(text)]
    except (ValueError, TypeError):
        values = []
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise KinematicsError(f"{where}: expected a list of six numbers, got {text!r}")
    return tuple(values)  # type: ignore[return-value]
