"""A person of round cones who walks an elliptic loop and waves whenever the path faces the cameras.

The walk is closed-form: feet rest on footholds of the path and swing between them, knees follow by inverse
kinematics of two bones, arms swing against the legs. The loop's period sets the speed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from camera_node.synthetic import motion
from camera_node.synthetic.motion import PERIOD_UNIT_S
from camera_node.synthetic.placement import MovingBody, Part
from camera_node.synthetic.scene_parameters import MAX_SPEED_M_PER_S
from camera_node.synthetic.shapes import RoundCone, Shape, Sphere
from camera_node.synthetic.textures import Bands, Plaid, Plain, Spots, Stripes, Texture
from freshfield.geometry import Array

STILL_PHASE = 0.62  # of who stands still: mid-wave
_CYCLES = 3  # gait cycles in one loop: strides of about 1.2 m
_ANKLE_M = 0.07
_THIGH_M, _SHIN_M = 0.42, 0.41
_UPPER_ARM_M, _FOREARM_M = 0.29, 0.25
# Bounds of a randomly drawn walk relative to the scene's own: shift of the center, factors of radii and
# speed. Within them it stays clear of the furniture.
_SHIFT_M, _RADIUS_FACTORS, _SPEED_FACTORS = 0.2, (0.75, 1.15), (0.7, 1.4)


@dataclass(frozen=True)
class Walk:
    """An elliptic walk.

    center: on the floor, meters. radii: of the ellipse, meters, multiplied by ``scale``.
    period_s: time for one loop.
    still: the person stands still.
    direction: 1.0 is counterclockwise from above, -1.0 clockwise.
    start_s: time into the loop at instant 0.
    """

    center: tuple[float, float]
    radii: tuple[float, float]
    period_s: float
    scale: float = 1.0
    still: bool = False
    direction: float = 1.0
    start_s: float = 0.0

    def phase(self, t_s: float) -> float:
        """Phase in [0, 1) of an instant."""
        if self.still:
            return STILL_PHASE
        return motion.phase_of(t_s + self.start_s, self.period_s)

    def at(self, phase: float) -> tuple[float, float]:
        """Position on the floor at a phase, in meters."""
        a = 2 * math.pi * phase * self.direction
        rx, ry = self.radii[0] * self.scale, self.radii[1] * self.scale
        return self.center[0] + rx * math.cos(a), self.center[1] + ry * math.sin(a)

    def heading(self, phase: float) -> tuple[float, float]:
        """Unit vector along the path at a phase."""
        a = 2 * math.pi * phase * self.direction
        x, y = -self.radii[0] * math.sin(a) * self.direction, self.radii[1] * math.cos(a) * self.direction
        n = math.hypot(x, y)
        return x / n, y / n


def _body_parts() -> list[tuple[str, Part]]:
    skin = Plain((0.86, 0.63, 0.50))
    shirt = Plaid((0.80, 0.20, 0.16), (0.30, 0.08, 0.12), (0.98, 0.86, 0.62), 1 / 8, 0.13)
    sleeve = Plaid((0.80, 0.20, 0.16), (0.30, 0.08, 0.12), (0.98, 0.86, 0.62), 1 / 4, 0.13)
    jeans = Stripes((0.16, 0.26, 0.50), (0.24, 0.38, 0.64), 1 / 6, axis=0, soft=0.08)
    boots = Plain((0.36, 0.21, 0.12))
    hair = Plain((0.22, 0.13, 0.08))
    face: Texture = Spots(
        Bands(skin, [(0.17, 0.33, -0.52, -0.40, (0.66, 0.24, 0.22))], soft=0.05),
        [(0.20, 0.12, 0.028, (0.12, 0.10, 0.10)), (0.30, 0.12, 0.028, (0.12, 0.10, 0.10))],
        soft=0.02,
    )
    belt: Texture = Bands(jeans, [(-9.0, 9.0, 0.05, 0.09, (0.15, 0.10, 0.07))])
    limbs: list[tuple[str, Shape, Texture]] = [
        ("upper_arm", RoundCone(0.058, 0.046, _UPPER_ARM_M), sleeve),
        ("forearm", RoundCone(0.046, 0.036, _FOREARM_M), skin),
        ("hand", Sphere(0.05), skin),
        ("thigh", RoundCone(0.088, 0.062, _THIGH_M), jeans),
        ("shin", RoundCone(0.062, 0.045, _SHIN_M), jeans),
        ("foot", RoundCone(0.055, 0.042, 0.17), boots),
    ]
    return [
        ("pelvis", Part(RoundCone(0.145, 0.135, 0.12), belt)),
        ("torso", Part(RoundCone(0.135, 0.165, 0.33), shirt)),
        ("neck", Part(RoundCone(0.05, 0.05, 0.12), skin)),
        ("head", Part(Sphere(0.12), face)),
        ("hair", Part(Sphere(0.124), hair)),
        *((f"{name}_{side}", Part(shape, texture)) for name, shape, texture in limbs for side in "lr"),
    ]


# Local scales of parts that are not round.
_SCALES = {
    "pelvis": (1.0, 0.72, 1.0),
    "torso": (1.0, 0.66, 1.0),
    "head": (0.80, 0.95, 1.10),
    "hair": (0.84, 0.95, 1.06),
    "hand_l": (0.7, 1.0, 1.25),
    "hand_r": (0.7, 1.0, 1.25),
}
# Spheres that shade the floor: part and radius (m).
_LEG = {"foot": 0.10, "shin": 0.08, "thigh": 0.10}
_CONTACT = {f"{part}_{side}": radius for part, radius in _LEG.items() for side in "lr"} | {"pelvis": 0.14}


def _unit(v: Array) -> Array:
    return v / (math.sqrt((v * v).sum()) or 1.0)


def bones(walk: Walk, phase: float) -> tuple[Array, Array, Array]:
    """Start, end and side vectors (M, 3) of every part at a phase, in the order of the parts."""
    x, y = walk.at(phase)
    fx, fy = walk.heading(phase)
    forward, right, up = np.array([[fx, fy, 0.0], [fy, -fx, 0.0], [0.0, 0.0, 1.0]])
    gait = 2 * math.pi * _CYCLES * phase
    swing, bob = math.sin(gait), -0.025 * math.cos(2 * gait)  # lowest when the legs are apart

    pelvis = np.array([x, y, 0.845 + bob])
    waist = pelvis + (0.10 * up + 0.01 * forward)
    chest = waist + (0.33 * up + 0.035 * forward)
    # Shoulders turn against the hips.
    twist = 0.16 * swing
    shoulder_axis = _unit(math.cos(twist) * right + math.sin(twist) * forward)
    head = chest + (0.285 * up + 0.03 * forward)
    crown = head + (0.028 * up - 0.026 * forward)
    ends = {
        "pelvis": (pelvis - 0.03 * up, pelvis + 0.12 * up),
        "torso": (waist, chest),
        "neck": (chest + 0.08 * up, head),
        "head": (head, head + up),
        "hair": (crown, crown + up),
    }

    # Wave with the right hand while the path faces the cameras (-y), smoothly blended in and out.
    wave = motion.smoothstep((-fy + 0.05) / 0.8)
    wave_side = math.sin(2 * gait)
    for name, sign in (("l", -1.0), ("r", 1.0)):
        shoulder = chest + (0.205 * sign * shoulder_axis + 0.05 * up)
        a = 0.55 * swing * sign
        upper = _unit(-math.cos(a) * up + math.sin(a) * forward + 0.16 * sign * right)
        b = a + 0.55
        lower = _unit(-math.cos(b) * up + math.sin(b) * forward + 0.04 * sign * right)
        if sign > 0 and wave > 0.0:
            raised = _unit(0.25 * up + 0.9 * right + 0.25 * forward)
            waving = _unit(up + (0.55 * wave_side + 0.1) * right + 0.2 * forward)
            # Blend through the side: a straight blend from hanging to raised would pass through zero.
            keep, via = (1 - wave) ** 2, 2 * wave * (1 - wave)
            upper = _unit(keep * upper + via * right + wave * wave * raised)
            lower = _unit(keep * lower + via * right + via * forward + wave * wave * waving)
        elbow = shoulder + _UPPER_ARM_M * upper
        wrist = elbow + _FOREARM_M * lower
        hand = wrist + 0.05 * lower

        hip = pelvis + 0.095 * sign * right
        at, lift = motion.footstep_phase(phase, _CYCLES, 0.0 if sign < 0 else 0.5)
        px, py = walk.at(at)
        hx, hy = walk.heading(at)
        toes, out = np.array([[hx, hy, 0.0], [hy, -hx, 0.0]])
        height = _ANKLE_M + 0.11 * math.sin(math.pi * lift) ** 2
        ankle = np.array([px, py, height]) + 0.09 * sign * out
        knee = motion.two_bone_ik(hip, ankle, _THIGH_M, _SHIN_M, forward)
        pitch = -0.5 * math.sin(2 * math.pi * lift) if lift > 0.0 else 0.0
        ahead = _unit(math.cos(pitch) * toes + (math.sin(pitch) - 0.06) * up)
        heel = ankle + (-0.03 * ahead - 0.01 * up)
        ends[f"upper_arm_{name}"], ends[f"forearm_{name}"] = (shoulder, elbow), (elbow, wrist)
        ends[f"hand_{name}"] = (hand, hand + 0.1 * lower)
        ends[f"thigh_{name}"], ends[f"shin_{name}"] = (hip, knee), (knee, ankle)
        ends[f"foot_{name}"] = (heel, heel + ahead)

    side = [shoulder_axis if name == "torso" else right for name in _NAMES]
    start, end = np.array([ends[name] for name in _NAMES]).transpose(1, 0, 2)
    return start, end, np.array(side)


_PARTS = _body_parts()
_NAMES = [name for name, _ in _PARTS]
_ROUND = np.array([n.split("_")[0] in ("head", "hair", "hand", "foot") for n in _NAMES])
_SCALE_ROWS = np.array([_SCALES.get(n, (1.0, 1.0, 1.0)) for n in _NAMES])


def walking_person(walk: Walk) -> MovingBody:
    """The person as a body of the world."""

    def matrices(t_s: float) -> Array:
        out = motion.bone_frames(*bones(walk, walk.phase(t_s)))
        out[:, :3, :3] *= _SCALE_ROWS[:, None, :]
        return out

    contact = tuple((_NAMES.index(n), r) for n, r in _CONTACT.items())
    return MovingBody(tuple(part for _, part in _PARTS), matrices, contact)


# Cached, because a process that builds scenes needs the same walk several times (truth, cameras, episodes).
@lru_cache(256)
def loop_length_m(walk: Walk) -> float:
    """Meters that the middles of the person's parts travel in one loop, averaged over the parts."""

    def middles(phase: float) -> Array:
        start, end, _ = bones(walk, phase)
        # Heads, hands and feet count by their position, not by the end of their axis.
        return np.where(_ROUND[:, None], start, 0.5 * (start + end))

    return motion.mean_path_m(middles)


def make_walk(
    center: tuple[float, float], radii: tuple[float, float], speed_m_per_s: float, seed: int | None = None
) -> Walk:
    """The walk on which the person's parts move at ``speed_m_per_s`` on average; 0 stands still. The period
    is rounded to a multiple of PERIOD_UNIT_S, and the ellipse scaled to keep the speed.

    center, radii: of the ellipse, meters.
    seed: draws a variation of the path, its direction, its start and the speed; None: no variation.
    """
    if speed_m_per_s == 0.0:
        return Walk(center, radii, PERIOD_UNIT_S, still=True)
    if seed is not None:
        return _draw_walk(center, radii, speed_m_per_s, seed)
    walk = Walk(center, radii, 1.0)
    period = motion.period_for(loop_length_m(walk), speed_m_per_s)
    for _ in range(3):  # the length is nearly linear in the scale
        scale = walk.scale * speed_m_per_s * period / loop_length_m(walk)
        walk = Walk(center, radii, period, scale)
    return walk


def _draw_walk(center: tuple[float, float], radii: tuple[float, float], speed_m_per_s: float, seed: int) -> Walk:
    rng = np.random.default_rng(seed)
    dx, dy = rng.uniform(-_SHIFT_M, _SHIFT_M, 2).tolist()
    wide, deep = rng.uniform(*_RADIUS_FACTORS, 2).tolist()
    speed = min(speed_m_per_s * float(np.exp(rng.uniform(*np.log(_SPEED_FACTORS)))), MAX_SPEED_M_PER_S)
    direction, start = (1.0 if rng.random() < 0.5 else -1.0), float(rng.random())
    walk = make_walk((center[0] + dx, center[1] + dy), (radii[0] * wide, radii[1] * deep), speed)
    return replace(walk, direction=direction, start_s=start * walk.period_s)
