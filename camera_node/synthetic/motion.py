"""Periodic analytic motion: phases, closed paths, footsteps and the two-bone limb.

All motion is a function of a phase in [0, 1) and nothing is integrated, so instants can be evaluated in any
order, and a run of a year is as exact as a run of a second.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from freshfield.geometry import Array

Vector = tuple[float, float, float]

# Periods are whole multiples of this, so that frame sequences at the usual rates repeat after few frames:
# 0.6 s holds 9 frames at 15 a second, 15 at 25, 18 at 30 and 20 at one every 30 ms.
PERIOD_UNIT_S = 0.6
_STANCE = 0.5  # share of a gait cycle for which a foot stands
_PATH_SAMPLES = 120


def phase_of(t_s: float, period_s: float) -> float:
    """Phase in [0, 1) of an instant. Raises ValueError for a non-finite instant."""
    if not math.isfinite(t_s):
        raise ValueError(f"time must be finite, got {t_s}")
    phase = math.fmod(t_s, period_s) / period_s
    phase = phase + 1.0 if phase < 0.0 else phase
    return 0.0 if phase >= 1.0 else phase


def period_for(path_m: float, speed_m_per_s: float) -> float:
    """Period (s) of a loop of ``path_m`` at about this speed, a multiple of PERIOD_UNIT_S."""
    return max(1, round(path_m / speed_m_per_s / PERIOD_UNIT_S)) * PERIOD_UNIT_S


def smoothstep(x: float) -> float:
    """0 below 0, 1 above 1, smooth between."""
    x = min(1.0, max(0.0, x))
    return x * x * (3.0 - 2.0 * x)


def footstep_phase(phase: float, cycles: int, offset: float) -> tuple[float, float]:
    """A foot's position on the path (a phase) and the progress of its swing (0 while it stands), with the
    body at ``phase``.

    cycles: gait cycles in a loop. In each, the foot rests for a share _STANCE at the position that the body
        passes at mid-stance, then swings smoothly to the next one.
    offset: of this foot's cycle, in cycles.
    """
    x = phase * cycles + offset
    whole = math.floor(x)
    swing = max(0.0, (x - whole - _STANCE) / (1.0 - _STANCE))
    at = whole + 0.5 * _STANCE + smoothstep(swing)
    return (at - offset) / cycles, swing


def two_bone_ik(root: Array, tip: Array, upper: float, lower: float, pole: Array) -> Array:
    """The joint (3,) between two bones from ``root`` to ``tip`` (law of cosines), bent towards ``pole``.

    upper, lower: lengths of the bones. pole: unit vector.
    The bones keep their lengths up to 9/10 of their reach. Beyond that both stretch a little: the bend is
    proportional to the square root of the remaining reach, so the joint would snap straight. They are never
    fully straight.
    """
    to = tip - root
    distance = math.sqrt((to * to).sum())
    if distance < 1e-9:
        return root + upper * pole
    along_axis = to / distance
    soft, full = 0.9 * (upper + lower), 0.995 * (upper + lower)
    reach = max(distance, abs(upper - lower))
    if distance > soft:
        reach = soft + (full - soft) * math.tanh((distance - soft) / (full - soft))
    stretch = max(1.0, distance / reach)
    along = (upper * upper - lower * lower + reach * reach) / (2.0 * reach)
    out = stretch * math.sqrt(max(0.0, upper * upper - along * along))
    across = pole - (pole * along_axis).sum() * along_axis
    norm = math.sqrt((across * across).sum()) or 1.0
    return root + stretch * along * along_axis + out / norm * across


def bone_frames(start: Array, end: Array, side: Array) -> Array:
    """Rigid frames (M, 4, 4) at ``start`` (M, 3): local z towards ``end`` (M, 3), local x as near as possible
    to ``side`` (M, 3)."""
    z = end - start
    length = np.linalg.norm(z, axis=1, keepdims=True)
    z = np.where(length > 1e-12, z / np.maximum(length, 1e-12), [[0.0, 0.0, 1.0]])
    y = np.cross(z, side)
    norm = np.linalg.norm(y, axis=1, keepdims=True)
    # A bone along its side vector has no preferred roll: use any perpendicular.
    fallback = np.cross(z, np.where(np.abs(z[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    y = np.where(norm < 1e-6, fallback, y)
    y /= np.linalg.norm(y, axis=1, keepdims=True)
    out = np.zeros((len(start), 4, 4))
    out[:, :3, 0], out[:, :3, 1], out[:, :3, 2], out[:, :3, 3] = np.cross(y, z), y, z, start
    out[:, 3, 3] = 1.0
    return out


def mean_path_m(points_at: Callable[[float], Array]) -> float:
    """Meters that the points (M, 3) = points_at(phase) travel in one loop, averaged over the points."""
    p = np.stack([points_at(k / _PATH_SAMPLES) for k in range(_PATH_SAMPLES)])
    return float(np.linalg.norm(np.diff(p, axis=0, append=p[:1]), axis=2).sum(axis=0).mean())
