"""The next hand pose of a guided session, by greedy A-optimal design.

The information of a sample depends on the poses alone, so it is known in advance. Of many random target poses
in front of the camera, the one that lowers the variance of X most is proposed.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from camera_node.robot.calibration.hand_eye.closed_form import predicted_hand
from camera_node.robot.calibration.hand_eye.joint_refinement import sample_information
from camera_node.robot.calibration.hand_eye.samples import Array, Samples, angles, inverse, transform_of
from freshfield.geometry import so3_exp

_CANDIDATES = 120
MAX_TILT_DEG = 50.0
# A rotation of X is weighted by the motion that it causes at this distance from the camera.
_LEVER_M = 0.3
# Offset of the target's middle from the image's, as a share of its distance.
_OFF_MIDDLE = 0.08
_FIRST_TURN_DEG = 15.0


def propose_pose(
    samples: Samples,
    x: Array,
    y: Array,
    noise: tuple[float, float],
    middle: Array,
    rng: np.random.Generator,
    new_deg: float = 8.0,
) -> Array:
    """Hand pose (4, 4) in base for the best of 120 random target poses, at distances already seen, tilted by
    up to 50 degrees, with any roll.

    x, y: (4, 4), the current estimates of X and Y.
    noise: of the arm (radians, meters).
    middle: (3,) of the target, in its axes.
    new_deg: hands rotated by at least this from earlier ones, and not much farther out, are preferred.
    """
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
    return np.asarray(hands[np.argmin(cost)])


def initial_pose(start: Array, taken: int) -> Array:
    """Hand pose (4, 4) to propose while X is unknown: that of the first sample, rotated by 15 degrees about
    x, y and z in turn, then by -15, so that the target stays in the image."""
    turn = np.zeros(3)
    turn[taken % 3] = np.deg2rad(_FIRST_TURN_DEG) * (1 if taken // 3 % 2 == 0 else -1)
    out = start.copy()
    out[:3, :3] = start[:3, :3] @ so3_exp(turn)
    return out


def describe_motion(now: Array, wanted: Array) -> str:
    """Instruction to an operator to move the hand from one pose (4, 4) to another, in its own axes."""
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
    """Random targets (N, 4, 4) whose middle (3,) is near that of the image, at distances already seen."""
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
