"""Forward and inverse kinematics of a six-axis arm (thesis 4.2.1).

An arm by Universal Robots is a chain of standard Denavit-Hartenberg links,
``T_{i-1}^i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)``. Forward kinematics is the product of six links.
Inverse kinematics has up to eight solutions (postures), found in closed form (Hawkins 2013, "Analytic
inverse kinematics for the Universal Robots UR-5/UR-10 arms"). The links of a calibrated arm do not
have the closed form's exact geometry, so each posture is then corrected by Newton's steps.

The arm loses a direction of motion where the Jacobian's determinant vanishes; for these arms it is
``a2 a3 sin(q5) sin(q3) (a2 cos(q2) + a3 cos(q2 + q3) + d5 sin(q2 + q3 + q4))`` up to its sign, whose three
factors are the wrist, the elbow and the shoulder singularity.
"""

from __future__ import annotations

import configparser
import dataclasses
import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from camera_node.robot.arm import ArmError
from camera_node.robot.arm.arm_constants import SINGULAR_DEG, SINGULAR_M
from freshfield.geometry import Array, se3_inverse, so3_log
from freshfield.untrusted import read_text

Six = tuple[float, float, float, float, float, float]

_ZEROS: Six = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
# A target beyond the reach by no more than this rounding error counts as at its edge.
_REACH_TOLERANCE = 1e-9
_NEWTON_STEPS = 6  # from a posture of the nominal arm, millimeters away; each doubles the number of right digits
_REACHED_M = 1e-7
_REACHED_RAD = 1e-7


@dataclass(frozen=True)
class ArmModel:
    """Denavit-Hartenberg parameters and limits of one arm.

    d_m, a_m, alpha_rad: of each link.
    theta_rad: added to each joint's angle.
    lower_rad, upper_rad: joint limits.
    speed_rad_s: maximum speed of each joint.
    nominal: the uncalibrated model, for which the closed form is solved; None: this one.
    """

    name: str
    d_m: Six
    a_m: Six
    alpha_rad: Six
    theta_rad: Six = _ZEROS
    lower_rad: Six = (-2 * math.pi,) * 6  # type: ignore[assignment]
    upper_rad: Six = (2 * math.pi,) * 6  # type: ignore[assignment]
    speed_rad_s: Six = (math.pi,) * 3 + (2 * math.pi,) * 3  # type: ignore[assignment]
    nominal: ArmModel | None = None

    @property
    def nominal_model(self) -> ArmModel:
        """The uncalibrated model. Its link frames lie within the arm's parts, as clearances require. Those
        of a calibrated model do not: the factory's fit puts meters into lengths along parallel axes, which
        nearly cancel at the flange, so the elbow's frame may lie meters away."""
        return self.nominal or self

    def link_frames(self, joints: ArrayLike) -> Array:
        """Base-from-link transforms (..., 7, 4, 4) for joint angles (..., 6) in radians: the base itself, then
        each link; the last one is the flange. For the positions of the arm's parts use ``nominal_model``. Raises
        ArmError for angles that are not finite."""
        q = _check_joints(joints)
        out = np.empty((*q.shape[:-1], 7, 4, 4))
        out[..., 0, :, :] = np.eye(4)
        for i in range(6):
            link = _dh_transform(q[..., i] + self.theta_rad[i], self.d_m[i], self.a_m[i], self.alpha_rad[i])
            np.matmul(out[..., i, :, :], link, out=out[..., i + 1, :, :])
        return out

    def forward(self, joints: ArrayLike) -> Array:
        """Base-from-flange transforms (..., 4, 4) for joint angles (..., 6) in radians (thesis 4.1)."""
        return np.asarray(self.link_frames(joints)[..., 6, :, :])

    def jacobian(self, joints: ArrayLike) -> Array:
        """Geometric Jacobian (6, 6) at the flange in base axes: rows are linear (m/rad), then angular."""
        links = self.link_frames(joints)
        axes = links[:6, :3, 2]
        levers = links[6, :3, 3] - links[:6, :3, 3]
        return np.concatenate([np.cross(axes, levers).T, axes.T])

    def singular(self, joints: ArrayLike) -> NDArray[np.bool_]:
        """Whether joint angles (..., 6) are near a singularity, (...): of the shoulder (the wrist's center within 2 cm
        of the base's axis), the elbow or the wrist (within 5 degrees)."""
        base = self.nominal_model
        _, q2, q3, q4, q5, _ = np.moveaxis(_check_joints(joints), -1, 0)
        reach_m = base.a_m[1] * np.cos(q2) + base.a_m[2] * np.cos(q2 + q3) + base.d_m[4] * np.sin(q2 + q3 + q4)
        bent = np.minimum(np.abs(np.sin(q3)), np.abs(np.sin(q5)))
        return np.asarray((np.abs(reach_m) < SINGULAR_M) | (bent < math.sin(math.radians(SINGULAR_DEG))))

    def inverse(self, target: ArrayLike) -> list[Array]:
        """All postures (6,), at most eight, that bring the flange to a target, base-from-flange (4, 4): angles in
        [-pi, pi]. If the wrist is singular, joints 4 and 6 share their turn in one of many ways."""
        wanted = np.asarray(target, dtype=np.float64)
        if wanted.shape != (4, 4) or not np.all(np.isfinite(wanted)):
            raise ArmError("the target must be a finite 4 x 4 matrix")
        found = _closed_form(self.nominal_model, wanted)
        if self.nominal is not None:
            for _ in range(_NEWTON_STEPS):
                left = [pose_difference(self.forward(q), wanted) for q in found]
                found = [q + np.linalg.lstsq(self.jacobian(q), off, rcond=1e-6)[0] for q, off in zip(found, left)]
        return [_wrapped(q) for q in found if _reaches(self.forward(q), wanted)]


# Universal Robots' data sheet (https://www.universal-robots.com/articles/ur/application-installation/
# dh-parameters-for-calculations-of-kinematics-and-dynamics/).
UR3E = ArmModel(
    name="ur3e",
    d_m=(0.15185, 0.0, 0.0, 0.13105, 0.08535, 0.0921),
    a_m=(0.0, -0.24355, -0.2132, 0.0, 0.0, 0.0),
    alpha_rad=(math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0),
)
MODELS = {UR3E.name: UR3E}


def apply_calibration(model: ArmModel, file: Path) -> ArmModel:
    """``model`` with one robot's own deviations, measured at the factory, from its ``calibration.conf``.

    The controller stores the file in ``/root/.urcontrol/``. It is an INI file whose section ``mounting`` has
    ``delta_theta``, ``delta_a``, ``delta_d`` and ``delta_alpha``, each a list of six numbers (radians and
    meters) to add to the data sheet's Denavit-Hartenberg parameters. A missing list is zero. Raises
    ArmError, also for a file without any of them.
    """
    parser = configparser.ConfigParser(inline_comment_prefixes=("#", ";"), interpolation=None, strict=False)
    try:
        parser.read_string(read_text(file))
    except (OSError, UnicodeDecodeError, configparser.Error) as error:
        raise ArmError(f"{file}: cannot be read: {' '.join(str(error).split())}") from None
    changed: dict[str, Six] = {}
    for section in parser.sections():
        for key, name in (("theta", "theta_rad"), ("a", "a_m"), ("d", "d_m"), ("alpha", "alpha_rad")):
            if f"delta_{key}" in parser[section]:
                deltas = _parse_six(parser[section][f"delta_{key}"], f"{file}: [{section}] delta_{key}")
                changed[name] = tuple(v + x for v, x in zip(getattr(model, name), deltas))  # type: ignore[assignment]
    if not changed:
        raise ArmError(f"{file}: has no delta_theta, delta_a, delta_d or delta_alpha")
    return dataclasses.replace(
        model,
        name=f"{model.name} ({file.name})",
        nominal=model.nominal or model,
        **changed,  # type: ignore[arg-type]
    )


def _closed_form(arm: ArmModel, target: Array) -> list[Array]:
    """Joint angles (6,) of every posture of an uncalibrated arm."""
    (d1, _, _, d4, d5, d6), (_, a2, a3, *_) = arm.d_m, arm.a_m
    r = target[:3, :3]
    wrist = target[:3, 3] - d6 * r[:, 2]
    out = math.hypot(wrist[0], wrist[1])
    if out < d4 - _REACH_TOLERANCE:
        return []  # inside the cylinder that the forearm's offset makes unreachable
    around = math.acos(min(1.0, d4 / out))
    postures = []
    for q1 in {math.atan2(wrist[1], wrist[0]) + s * around + math.pi / 2 for s in (1.0, -1.0)}:
        s1, c1 = math.sin(q1), math.cos(q1)
        # sin(q5) from its two components, not from the cosine: exact for a straight wrist.
        x6, y6 = r[0, 0] * s1 - r[1, 0] * c1, r[1, 1] * c1 - r[0, 1] * s1
        sin5, cos5 = math.hypot(x6, y6), r[0, 2] * s1 - r[1, 2] * c1
        for sign in (1.0, -1.0):
            q5 = math.atan2(sign * sin5, cos5)
            q6 = math.atan2(sign * y6, sign * x6)
            first = _dh_transform(q1, d1, 0.0, math.pi / 2)
            last = _dh_transform(q5, d5, 0.0, -math.pi / 2) @ _dh_transform(q6, d6, 0.0, 0.0)
            middle = se3_inverse(first) @ target @ se3_inverse(last)
            x, y = (middle[:3, 3] - d4 * middle[:3, 1])[:2]
            cos3 = (x * x + y * y - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
            if abs(cos3) > 1.0 + _REACH_TOLERANCE:
                continue  # farther than the stretched arm reaches, or nearer than the folded one
            for bend in (1.0, -1.0):
                q3 = bend * math.acos(max(-1.0, min(1.0, cos3)))
                q2 = math.atan2(y, x) - math.atan2(a3 * math.sin(q3), a2 + a3 * math.cos(q3))
                elbow = _dh_transform(q2, 0.0, a2, 0.0) @ _dh_transform(q3, 0.0, a3, 0.0)
                turned = elbow[:3, :3].T @ middle[:3, :3]
                q4 = math.atan2(turned[1, 0], turned[0, 0])
                postures.append(np.array([q1, q2, q3, q4, q5, q6]))
    return postures


def _dh_transform(theta: ArrayLike, d: float, a: float, alpha: float) -> Array:
    """Rz(theta) Tz(d) Tx(a) Rx(alpha), (..., 4, 4) for angles (...)."""
    ct, st = np.cos(theta), np.sin(theta)
    ca, sa = math.cos(alpha), math.sin(alpha)
    out = np.zeros((*np.shape(theta), 4, 4))
    out[..., 0, 0], out[..., 0, 1], out[..., 0, 2], out[..., 0, 3] = ct, -st * ca, st * sa, a * ct
    out[..., 1, 0], out[..., 1, 1], out[..., 1, 2], out[..., 1, 3] = st, ct * ca, -ct * sa, a * st
    out[..., 2, 1], out[..., 2, 2], out[..., 2, 3] = sa, ca, d
    out[..., 3, 3] = 1.0
    return out


def pose_difference(now: Array, wanted: Array) -> Array:
    """Difference (6,) from pose ``now`` to pose ``wanted``, both (4, 4), in base axes: meters, then a
    rotation vector in radians."""
    return np.concatenate([wanted[:3, 3] - now[:3, 3], so3_log(wanted[:3, :3] @ now[:3, :3].T)])


def _reaches(now: Array, wanted: Array) -> bool:
    left = np.abs(pose_difference(now, wanted))
    return bool(left[:3].max() < _REACHED_M and left[3:].max() < _REACHED_RAD)


def _wrapped(q: Array) -> Array:
    """Angles in [-pi, pi)."""
    return (q + math.pi) % (2 * math.pi) - math.pi


def _check_joints(values: ArrayLike) -> Array:
    q = np.asarray(values, dtype=np.float64)
    if q.shape[-1:] != (6,) or not np.all(np.isfinite(q)):
        raise ArmError(f"expected six finite joint angles, got {values!r}")
    return q


def _parse_six(text: str, where: str) -> Six:
    try:
        values = [float(v) for v in json.loads(text)]
    except (ValueError, TypeError):
        values = []
    if len(values) != 6 or not all(map(math.isfinite, values)):
        raise ArmError(f"{where}: expected a list of six numbers, got {text!r}")
    return tuple(values)  # type: ignore[return-value]
