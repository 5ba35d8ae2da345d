"""Where to take the next sample from: the pose that makes the answer surest (greedy A-optimal design).

What a sample will be worth is known before it is taken: its share of the information depends on the poses
alone. So the target is imagined at many places before the camera, and the one that lowers the variance of X
the most is proposed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from camera_node.robot.calibration.hand_eye.closed_form import predicted_hand
from camera_node.robot.calibration.hand_eye.joint_refinement import sample_information
from camera_node.robot.calibration.hand_eye.samples import Array, Samples, angles, inverse, transform_of
from freshfield.geometry import so3_exp

_CANDIDATES = 120
MAX_TILT_DEG = 50.0
# A turn of X is weighed by what it moves at this distance from the camera.
_LEVER_M = 0.3
# Share of the distance by which the target's middle may be off the picture's.
_OFF_MIDDLE = 0.08
_FIRST_TURN_DEG = 15.0


@dataclass(frozen=True)
class Proposal:
    """hand: (4, 4) in base. target: (4, 4), where the camera will then see the target. std_mm: of X with that
    sample added, the arm's noise staying what it is."""

    hand: Array
    target: Array
    std_mm: float


def propose_pose(
    samples: Samples,
    x: Array,
    y: Array,
    noise: tuple[float, float],
    middle: Array,
    rng: np.random.Generator,
    new_deg: float = 8.0,
) -> Proposal:
    """The best of 120 random places for the target: as far away as it has been seen, tilted by up to 50
    degrees, turned anyhow, but the hand turned by at least ``new_deg`` from where it has been and not much
    farther out than it has been. noise: the arm's (radians, metres). middle: (3,) of the target, its axes."""
    targets = _candidate_targets(samples, middle, rng)
    hands = predicted_hand(Samples(targets, targets, samples.setup), x, y)
    reach = np.linalg.norm(samples.hand[:, :3, 3], axis=1).max() * 1.05
    between = np.swapaxes(samples.hand[:, None, :3, :3], 2, 3) @ hands[None, :, :3, :3]
    turned_deg = np.degrees(angles(between)).min(axis=0)
    good = (np.linalg.norm(hands[:, :3, 3], axis=1) <= reach) & (turned_deg >= new_deg)
    if good.any():
        hands, targets = hands[good], targets[good]
    before = sample_information(replace(samples, covariance=None), x, y, noise).sum(axis=0)
    added = sample_information(Samples(hands, targets, samples.setup), x, y, noise)
    variances = np.linalg.inv(before + added)[:, :6, :6].diagonal(axis1=1, axis2=2)
    cost = variances[:, 3:].sum(axis=1) + _LEVER_M**2 * variances[:, :3].sum(axis=1)
    best = int(np.argmin(cost))
    return Proposal(hands[best], targets[best], float(np.sqrt(variances[best, 3:].sum()) * 1e3))


def initial_pose(start: Array, taken: int) -> Array:
    """(4, 4): hand poses to begin with, while nothing is known of X: where the first sample was taken, turned
    by 15 degrees about x, y and z in turn and back, so that the target hardly leaves the picture."""
    turn = np.zeros(3)
    turn[taken % 3] = np.deg2rad(_FIRST_TURN_DEG) * (1 if taken // 3 % 2 == 0 else -1)
    out = start.copy()
    out[:3, :3] = start[:3, :3] @ so3_exp(turn)
    return out


def describe_motion(now: Array, wanted: Array) -> str:
    """How to get from a hand pose (4, 4) to another, in the hand's own axes, to a person's precision."""
    step = inverse(now) @ wanted
    chord = step[:3, :3]
    vector = np.array([chord[2, 1] - chord[1, 2], chord[0, 2] - chord[2, 0], chord[1, 0] - chord[0, 1]])
    axis = int(np.argmax(np.abs(vector)))
    turn = float(np.degrees(angles(chord)))
    sign = "-" if vector[axis] < 0 else "+"
    moves = [f"{round(v * 100):+d} cm {name}" for name, v in zip("xyz", step[:3, 3]) if abs(v) >= 0.01]
    move = f", move {', '.join(moves)}" if moves else ""
    return f"turn by about {turn:.0f} degrees, mostly about its {sign}{'xyz'[axis]}{move}"


def _candidate_targets(samples: Samples, middle: Array, rng: np.random.Generator) -> Array:
    """(N, 4, 4) targets whose middle (3,) is near the middle of the picture, as far away as it has been."""
    depths = (samples.target @ np.append(middle, 1.0))[:, 2]
    out = []
    for _ in range(_CANDIDATES):
        tilt = np.deg2rad(MAX_TILT_DEG) * np.sqrt(rng.uniform())
        towards, roll = rng.uniform(-np.pi, np.pi, 2)
        turn = so3_exp([tilt * np.cos(towards), tilt * np.sin(towards), 0.0]) @ so3_exp([0.0, 0.0, roll])
        z = rng.uniform(depths.min(), depths.max())
        place = np.array([*rng.uniform(-_OFF_MIDDLE, _OFF_MIDDLE, 2) * z, z])
        out.append(transform_of(turn, place - turn @ middle))
    return np.array(out)
