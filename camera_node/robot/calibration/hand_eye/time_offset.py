"""The time offset between an arm's clock and a camera's, estimated from their motion.

For any X, hand and target rotate by the same angles (4.6), so their angular speeds are one signal on two
clocks. Their cross-correlation gives the offset to a fraction of a sample, over any range of offsets.
``refine`` then estimates the offset together with X and Y, by means of the hand's velocity.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate

from camera_node.robot.calibration import MAX_GAP_S, CalibrationError
from camera_node.robot.calibration.files import Track
from camera_node.robot.calibration.hand_eye.joint_refinement import Refinement, refine
from camera_node.robot.calibration.hand_eye.samples import (
    Array,
    Rotation,
    Samples,
    evenly_spaced,
    require_diversity,
    rotation_vectors,
    transform_of,
)

# Most samples to refine with. Neighboring ones add little information.
_MAX_SAMPLES = 400
_STEP_S = 0.01
# Window of the angular speed. A shorter one shows pose noise, a longer one smooths the motion away.
_WINDOW_S = 0.25
_MIN_CORRELATION, _RIVAL = 0.5, 0.97
_MIN_OVERLAP_S = 2.0
# Half the window of the hand's velocity.
_HALF_S = 0.02
_ROUNDS, _SETTLED_S = 10, 1e-6


@dataclass(frozen=True)
class StreamCalibration:
    """Result of two streams.

    samples: paired at the estimated offset.
    refined: X, Y and their uncertainty.
    offset_s, std_s: the hand's stamp of an instant minus the camera's, and its standard deviation.
    coarse_s, correlation: offset from the angular speeds, and their correlation there.
    unpaired: number of target poses without a hand pose near enough in time.
    """

    samples: Samples
    refined: Refinement
    offset_s: float
    std_s: float
    coarse_s: float
    correlation: float
    unpaired: int


def calibrate_streams(hand: Track, target: Track, setup: str, max_gap_s: float = MAX_GAP_S) -> StreamCalibration:
    """Time offset and hand-eye calibration from two streams.

    hand, target: hand in base, and target in camera.
    setup: eye-in-hand or eye-to-hand.
    max_gap_s: largest distance in time between a target pose and the nearest hand pose.
    Raises CalibrationError.
    """
    coarse_s, correlation = coarse_offset(hand, target)
    offset_s, start = coarse_s, None
    for _ in range(_ROUNDS):
        samples, velocity, unpaired = _paired(hand, target, offset_s, setup, max_gap_s)
        require_diversity(samples)
        found = refine(samples, start, velocity=velocity)
        start = (found.x, found.y)
        offset_s += found.offset_s
        if abs(offset_s - coarse_s) > 2 * _WINDOW_S:
            raise CalibrationError(
                f"the time offset does not settle near {coarse_s:.3f} s, where the angular speeds agree: is "
                "one of the streams that of another body, or an inverse?"
            )
        if abs(found.offset_s) < _SETTLED_S:
            break
    return StreamCalibration(samples, found, offset_s, found.offset_std_s, coarse_s, correlation, unpaired)


def coarse_offset(hand: Track, target: Track) -> tuple[float, float]:
    """Offset in seconds and the correlation there. Raises CalibrationError if the streams do not overlap, the
    motion does not vary, or two offsets fit equally well."""
    a, b = _angular_speed(hand), _angular_speed(target)
    for name, speed in (("hand", a), ("target", b)):
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
    score, count = _masked_correlation(a, b)
    enough = count * _STEP_S >= max(_MIN_OVERLAP_S, 0.5 * _STEP_S * min(len(a), len(b)))
    score[~enough] = -1.0
    best = int(np.argmax(score))
    if score[best] < _MIN_CORRELATION:
        raise CalibrationError(
            f"hand and target do not turn alike at any time offset (correlation {score[best]:.2f} at best): "
            "they are not of one motion, or it is too even to tell"
        )
    lag = best - (len(b) - 1)
    away = int(2 * _WINDOW_S / _STEP_S)
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] >= score[2:])) + 1
    rivals = [p for p in peaks if abs(p - best) > away and score[p] > _RIVAL * score[best]]
    if rivals:
        other = (rivals[0] - best) * _STEP_S
        raise CalibrationError(
            f"the motion repeats itself: an offset {abs(other):.2f} s {'later' if other > 0 else 'earlier'} "
            "fits as well; move the hand irregularly"
        )
    fraction = 0.0
    if 0 < best < len(score) - 1:
        left, middle, right = score[best - 1 : best + 2]
        curve = left - 2 * middle + right
        fraction = float(np.clip(0.5 * (left - right) / curve, -0.5, 0.5)) if curve < 0 else 0.0
    starts_s = (int(hand.times_ns[0]) - int(target.times_ns[0])) / 1e9
    return starts_s + (lag + fraction) * _STEP_S, float(score[best])


def _paired(hand: Track, target: Track, offset_s: float, setup: str, max_gap_s: float) -> tuple[Samples, Array, int]:
    """Samples at the target's stamps, the hand's velocity there (N, 6) in its own axes, and the number of
    stamps without a hand pose within ``max_gap_s``."""
    at = target.times_ns + round(offset_s * 1e9)
    half = round(_HALF_S * 1e9)
    now, before, after = (_interpolated(hand, at + d, max_gap_s) for d in (0, -half, half))
    good = np.flatnonzero(now[1] & before[1] & after[1])
    unpaired = len(at) - len(good)
    good = good[evenly_spaced(len(good), _MAX_SAMPLES)]
    poses, early, late = now[0][good], before[0][good], after[0][good]
    turns = rotation_vectors(np.swapaxes(early[:, :3, :3], 1, 2) @ late[:, :3, :3])
    shifts = (np.swapaxes(poses[:, :3, :3], 1, 2) @ (late[:, :3, 3:] - early[:, :3, 3:]))[..., 0]
    names = tuple(f"{(int(target.times_ns[i]) - int(target.times_ns[0])) / 1e9:.2f} s" for i in good)
    samples = Samples(poses, target.poses[good], setup, names=names)
    return samples, np.concatenate([turns, shifts], axis=1) / (2 * _HALF_S), unpaired


def _interpolated(track: Track, at_ns: NDArray[np.int64], max_gap_s: float) -> tuple[Array, NDArray[np.bool_]]:
    """Poses (N, 4, 4) by slerp and straight lines, and whether each is within ``max_gap_s`` of a sample."""
    times = track.times_ns
    after = np.clip(np.searchsorted(times, at_ns), 1, len(times) - 1)
    before = after - 1
    share = np.clip((at_ns - times[before]) / (times[after] - times[before]), 0.0, 1.0)
    gap = np.minimum(np.abs(at_ns - times[before]), np.abs(times[after] - at_ns))
    a, b = track.poses[before], track.poses[after]
    turns = rotation_vectors(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3])
    rotation = a[:, :3, :3] @ Rotation.from_rotvec(turns * share[:, None]).as_matrix()
    shift = a[:, :3, 3] + share[:, None] * (b[:, :3, 3] - a[:, :3, 3])
    inside = (at_ns >= times[0]) & (at_ns <= times[-1]) & (gap <= max_gap_s * 1e9)
    return transform_of(rotation, shift), inside


def _angular_speed(track: Track) -> Array:
    """Angular speed (radians per second) every ``_STEP_S`` from the first stamp on; NaN near a gap."""
    start, end = int(track.times_ns[0]), int(track.times_ns[-1])
    count = int((end - start) / 1e9 / _STEP_S)
    if count > 10_000_000:
        raise CalibrationError(f"a stream spans {(end - start) / 1e9:.0f} s: is one of its stamps on another clock?")
    at = start + np.arange(count, dtype=np.int64) * round(_STEP_S * 1e9)
    half = round(_WINDOW_S / 2 * 1e9)
    # In a gap no longer than the window, the mean speed over the gap is good enough.
    (a, a_known), (b, b_known) = (_interpolated(track, at + d, _WINDOW_S / 2) for d in (-half, half))
    turns = Rotation.from_matrix(np.swapaxes(a[:, :3, :3], 1, 2) @ b[:, :3, :3]).magnitude()
    return np.where(a_known & b_known, turns / _WINDOW_S, np.nan)


def _masked_correlation(a: Array, b: Array) -> tuple[Array, Array]:
    """Pearson's correlation of a[k + lag] with b[k] over the samples that are known in both, and their
    number, for lags -(len(b) - 1) to len(a) - 1."""
    ma, mb = (~np.isnan(v) for v in (a, b))
    a, b = (np.where(m, v - v[m].mean(), 0.0) for v, m in ((a, ma), (b, mb)))
    ma, mb = ma.astype(np.float64), mb.astype(np.float64)

    def cross(u: Array, v: Array) -> Array:
        return np.asarray(correlate(u, v, mode="full", method="fft"))

    count = np.maximum(np.round(cross(ma, mb)), 0.0)
    n = np.maximum(count, 1.0)
    sum_a, sum_b = cross(a, mb), cross(ma, b)
    top = cross(a, b) - sum_a * sum_b / n
    below = (cross(a * a, mb) - sum_a**2 / n) * (cross(ma, b * b) - sum_b**2 / n)
    # If nothing varies, rounding of the transforms leaves values just above zero.
    level = 1e-9 * max(float((a * a).sum() * (b * b).sum()), 1e-300)
    return np.where(below > level, top / np.sqrt(np.maximum(below, level)), -1.0), count
