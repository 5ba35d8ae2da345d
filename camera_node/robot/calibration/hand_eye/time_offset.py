"""The time offset between an arm's clock and a camera's, estimated from their motion.

For any X, flange and target rotate by the same angles (4.6), so their angular speeds are one signal on two
clocks. Their cross-correlation gives the offset to a fraction of a sample, over any range of offsets.
``refine`` then estimates the offset together with X and Y.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from camera_node.robot.calibration import MAX_GAP_S, CalibrationError
from camera_node.robot.calibration.hand_eye.refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Rotation,
    Samples,
    evenly_spaced,
    require_diversity,
    rotation_vectors,
)
from camera_node.robot.calibration.inputs import Track
from freshfield.geometry import se3

# Most samples to refine with. Neighboring ones add little information.
_MAX_SAMPLES = 400
_STEP_S = 0.01
_LONGEST_S = 1e5
# Window of the angular speed. A shorter one shows pose noise, a longer one smooths the motion away.
_WINDOW_S = 0.25
_MIN_CORRELATION, _RIVAL = 0.5, 0.97
_MIN_OVERLAP_S = 2.0
# Half the window of the flange's velocity. A shorter one shows the noise of its poses.
_HALF_S = 0.02
_ROUNDS, _SETTLED_S = 10, 1e-6


@dataclass(frozen=True)
class StreamCalibration:
    """Result of two streams.

    samples: paired at the estimated offset.
    refined: X, Y and their uncertainty.
    offset_s: the arm's stamp of an instant minus the camera's.
    coarse_s, correlation: offset from the angular speeds, and their correlation there.
    unpaired: number of target poses without a flange pose near enough in time.
    """

    samples: Samples
    refined: Refinement
    offset_s: float
    coarse_s: float
    correlation: float
    unpaired: int


def calibrate_streams(flange: Track, target: Track, setup: str, max_gap_s: float = MAX_GAP_S) -> StreamCalibration:
    """Time offset and hand-eye calibration from two streams.

    flange, target: flange in base, and target in camera.
    setup: eye-in-hand or eye-to-hand.
    max_gap_s: largest distance in time between a target pose and the nearest flange pose.
    Raises CalibrationError.
    """
    coarse_s, correlation = coarse_offset(flange, target)
    offset_s, start = coarse_s, None
    for _ in range(_ROUNDS):
        samples, velocity, unpaired = _paired(flange, target, offset_s, setup, max_gap_s)
        require_diversity(samples)
        found = refine(samples, velocity, start)
        start = found.x, found.y
        offset_s += found.offset_s
        if abs(offset_s - coarse_s) > 2 * _WINDOW_S:
            raise CalibrationError(
                f"the time offset does not settle near {coarse_s:.3f} s, where the angular speeds agree: is one of "
                "the streams that of another body, or an inverse?"
            )
        if abs(found.offset_s) < _SETTLED_S:
            break
    return StreamCalibration(samples, found, offset_s, coarse_s, correlation, unpaired)


def coarse_offset(flange: Track, target: Track) -> tuple[float, float]:
    """Offset in seconds and the correlation there. Raises CalibrationError if the streams do not overlap, the
    motion does not vary, or two offsets fit equally well."""
    a, b = _angular_speed(flange), _angular_speed(target)
    for name, speed in (("flange", a), ("target", b)):
        seen = speed[~np.isnan(speed)]
        if seen.size * _STEP_S < _MIN_OVERLAP_S:
            raise CalibrationError(
                f"the {name}'s stream has {seen.size * _STEP_S:.1f} s without gaps, at least "
                f"{_MIN_OVERLAP_S:g} s are needed to find the time offset"
            )
        if seen.max() < np.deg2rad(1.0):
            raise CalibrationError(
                f"the {name} hardly turns ({np.degrees(seen.max()):.2f} degrees a second at most): the time "
                "offset cannot be found from its motion"
            )
    score = _correlation(a, b)
    best = int(np.argmax(score))
    if score[best] < _MIN_CORRELATION:
        raise CalibrationError(
            f"flange and target do not turn alike at any time offset (correlation {score[best]:.2f} at best): "
            "they are not of one motion, or it is too even to tell"
        )
    away = int(2 * _WINDOW_S / _STEP_S)
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:])) + 1
    rivals = [p for p in peaks if abs(p - best) > away and score[p] > _RIVAL * score[best]]
    if rivals:
        other_s = (rivals[0] - best) * _STEP_S
        raise CalibrationError(
            f"the motion repeats itself: an offset {abs(other_s):.2f} s {'later' if other_s > 0 else 'earlier'} "
            "fits as well; move the arm irregularly"
        )
    starts_s = (int(flange.times_ns[0]) - int(target.times_ns[0])) / 1e9
    return starts_s + (best - (len(b) - 1)) * _STEP_S, float(score[best])


def _paired(flange: Track, target: Track, offset_s: float, setup: str, max_gap_s: float) -> tuple[Samples, Array, int]:
    """Samples at the target's stamps, the flange's velocity there (N, 6) in its own axes, and the number of stamps
    without a flange pose within ``max_gap_s``."""
    # Relative to the track's start, because a float of seconds since 1970 keeps a quarter of a microsecond only.
    at_s = (target.times_ns + round(offset_s * 1e9) - flange.times_ns[0]) / 1e9
    poses_at, gap_s = _interpolator(flange)
    good = np.flatnonzero(np.all([gap_s(at_s + shift_s) <= max_gap_s for shift_s in (-_HALF_S, 0.0, _HALF_S)], axis=0))
    unpaired = len(at_s) - len(good)
    good = good[evenly_spaced(len(good), _MAX_SAMPLES)]
    now, early, late = (poses_at(at_s[good] + shift_s) for shift_s in (0.0, -_HALF_S, _HALF_S))
    turns = rotation_vectors(np.swapaxes(early[:, :3, :3], 1, 2) @ late[:, :3, :3])
    shifts = (np.swapaxes(now[:, :3, :3], 1, 2) @ (late[:, :3, 3:] - early[:, :3, 3:]))[..., 0]
    names = tuple(f"{(int(target.times_ns[i]) - int(target.times_ns[0])) / 1e9:.2f} s" for i in good)
    samples = Samples(now, target.poses[good], setup, names)
    return samples, np.concatenate([turns, shifts], axis=1) / (2 * _HALF_S), unpaired


def _interpolator(track: Track) -> tuple[Callable[[Array], Array], Callable[[Array], Array]]:
    """Functions of seconds (N,) since a track's first stamp: its poses (N, 4, 4), by slerp and straight lines, and
    the distances (N,) to the nearest sample in seconds, infinite beyond the track's ends."""
    times_s = (track.times_ns - track.times_ns[0]) / 1e9
    rotations = track.poses[:, :3, :3]
    turns = rotation_vectors(np.swapaxes(rotations[:-1], 1, 2) @ rotations[1:])

    def before(at_s: Array) -> NDArray[np.intp]:
        return np.clip(np.searchsorted(times_s, at_s) - 1, 0, len(times_s) - 2)

    def poses(at_s: Array) -> Array:
        k = before(at_s)
        share = np.clip((at_s - times_s[k]) / (times_s[k + 1] - times_s[k]), 0.0, 1.0)[:, None]
        a, b = track.poses[k, :3, 3], track.poses[k + 1, :3, 3]
        return se3(rotations[k] @ Rotation.from_rotvec(turns[k] * share).as_matrix(), a + share * (b - a))

    def gaps(at_s: Array) -> Array:
        k = before(at_s)
        gap_s = np.minimum(np.abs(at_s - times_s[k]), np.abs(times_s[k + 1] - at_s))
        return np.where((at_s >= 0.0) & (at_s <= times_s[-1]), gap_s, np.inf)

    return poses, gaps


def _angular_speed(track: Track) -> Array:
    """Angular speed (radians per second) every ``_STEP_S`` from the first stamp on; NaN near a gap. Raises
    CalibrationError for a track of days."""
    seconds = int(track.times_ns[-1] - track.times_ns[0]) / 1e9
    if seconds > _LONGEST_S:
        raise CalibrationError(f"a stream spans {seconds:.0f} s: is one of its stamps on another clock?")
    poses, gaps = _interpolator(track)
    at_s: Array = np.arange(int(seconds / _STEP_S)) * np.float64(_STEP_S)
    ends = [at_s + shift_s for shift_s in (-_WINDOW_S / 2, _WINDOW_S / 2)]
    a, b = (poses(end)[:, :3, :3] for end in ends)
    turns = Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).magnitude() if len(at_s) else np.zeros(0)
    # In a gap no longer than the window, the mean speed over the gap is good enough.
    known = np.all([gaps(end) <= _WINDOW_S / 2 for end in ends], axis=0)
    return np.where(known, turns / _WINDOW_S, np.nan)


def _correlation(a: Array, b: Array) -> Array:
    """Correlation of a[k + lag] with b[k] for lags -(len(b) - 1) to len(a) - 1, over the samples that are known in
    both (not NaN); 1 if one is the other, delayed."""
    known_a, known_b = ((~np.isnan(v)).astype(np.float64) for v in (a, b))
    a, b = (np.nan_to_num(v - np.nanmean(v)) for v in (a, b))

    def cross(u: Array, v: Array) -> Array:
        return np.asarray(correlate(u, v, mode="full", method="fft"))

    power = np.sqrt(np.maximum(cross(a * a, known_b), 0.0) * np.maximum(cross(known_a, b * b), 0.0))
    # Where less than half of the motion overlaps, chance decides.
    enough = power > max(0.5 * float(power.max()), 1e-12)
    return np.where(enough, cross(a, b) / np.where(enough, power, 1.0), -1.0)
