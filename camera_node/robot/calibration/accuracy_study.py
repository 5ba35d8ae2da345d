"""Calibration accuracy against time and number of poses: three tables from a simulated hand with known truth.

- ``pairing``: error of the camera's pose (4.7) against the arm's reporting period and speed, for the nearest
  sample (thesis 4.3.3) and linear interpolation with slerp; and the processor time of one pairing.
- ``poses``: error of the hand-eye calibration against the number of poses, by method, beside the Cramer-Rao
  bound; arm noise .5 mm and .002 rad an axis. ``rms_mm_std``, ``rms_deg_std``: standard deviations of the
  errors over the trials, by which an error may be below its bound by chance. ``planned``: the refinement with
  poses that the guided session proposes after the first four; its bound is that of these poses.
- ``offset``: error of the time offset between arm and camera against the length of the recording and speed.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.pose.pairing import Interpolate, SampleBuffer
from camera_node.robot.arm.hand_eye_mount import EYE_IN_HAND, HandEye
from camera_node.robot.calibration import CalibrationError
from camera_node.robot.calibration.files import Track
from camera_node.robot.calibration.hand_eye import simulated
from camera_node.robot.calibration.hand_eye.calibrate import ALL_METHODS, REFINED, angle_deg, distance_mm
from camera_node.robot.calibration.hand_eye.closed_form import METHODS, solve
from camera_node.robot.calibration.hand_eye.joint_refinement import cramer_rao_bound, refine
from camera_node.robot.calibration.hand_eye.next_pose import propose_pose
from camera_node.robot.calibration.hand_eye.samples import Array, Samples, inverse
from camera_node.robot.calibration.hand_eye.time_offset import calibrate_streams
from freshfield.files import picture
from freshfield.geometry import Pose

Rows = list[dict[str, Any]]

INTERPOLATIONS: dict[str, Interpolate[Pose] | None] = {"nearest": None, "line": Pose.interpolate}
PERIODS_MS = (2.0, 8.0, 20.0, 50.0, 100.0, 200.0)
SPEEDS_M_PER_S = (0.05, 0.1, 0.25, 0.5, 1.0)
COUNTS = (4, 6, 8, 10, 15, 20, 30, 50)
PLANNED = "planned"
_NOISE = (simulated.ARM_RAD, simulated.ARM_M)
_FRAMES_PER_S = 30.0
# Error of a detected target pose at this distance (measured with rendered images).
_DETECTION_RAD, _DETECTION_M = 0.0005, 0.0003


def run_tables(quick: bool = False, seed: int = 0) -> Iterator[tuple[str, Rows]]:
    """Yield the name and rows of each table when it is done. quick: fewer frames and trials, for a run of
    seconds instead of two minutes."""
    periods_ms, speeds = (PERIODS_MS[::2], SPEEDS_M_PER_S[1::2]) if quick else (PERIODS_MS, SPEEDS_M_PER_S)
    yield "pairing", pairing(4.0 if quick else 20.0, periods_ms, speeds, seed)
    yield "poses", poses(COUNTS[::2] if quick else COUNTS, 10 if quick else 100, seed)
    yield "offset", offset(1 if quick else 5, (5.0, 20.0) if quick else (5.0, 10.0, 20.0, 40.0), seed)


def pairing(seconds: float, periods_ms: tuple[float, ...], speeds: tuple[float, ...], seed: int = 0) -> Rows:
    """Camera pose errors and pairing gaps over frames at 30 per second, with stamps independent of the arm's.
    The arm's poses are exact, so only the pairing contributes."""
    rng = np.random.default_rng([seed, 1])
    mount = HandEye(EYE_IN_HAND, simulated.CAMERA_IN_HAND)
    rows = []
    for speed in speeds:
        sweep = simulated.Sweep(speed)
        frames_s = np.sort(rng.uniform(1.0, 1.0 + seconds, int(seconds * _FRAMES_PER_S)))
        truth = sweep.cameras(frames_s)
        for period_ms in periods_ms:
            times_s = np.arange(0.0, seconds + 2.0, period_ms / 1e3)
            hands = [Pose.from_matrix(h) for h in sweep.hands(times_s)]
            for name, interpolate in INTERPOLATIONS.items():
                hand = SampleBuffer(interpolate, max_gap_ns=10**9, keep_ns=10**12)
                for t_s, pose in zip(times_s, hands):
                    hand.add(round(t_s * 1e9), pose)
                camera = mount.camera_poses(hand)
                begun = time.process_time()
                paired = [camera.at(round(t_s * 1e9)) for t_s in frames_s]
                spent = time.process_time() - begun
                found = [pose.matrix() for pose, _ in paired]
                mm = np.array([distance_mm(a, b) for a, b in zip(found, truth)])
                deg = np.array([angle_deg(a, b) for a, b in zip(found, truth)])
                rows.append(
                    {
                        "speed_m_per_s": speed,
                        "arm_period_ms": period_ms,
                        "pairing": name,
                        "gap_ms_mean": float(np.mean([gap_ns for _, gap_ns in paired])) / 1e6,
                        "mm_p50": float(np.median(mm)),
                        "mm_p95": float(np.quantile(mm, 0.95)),
                        "deg_p50": float(np.median(deg)),
                        "deg_p95": float(np.quantile(deg, 0.95)),
                        "us_a_pair": spent / len(frames_s) * 1e6,
                    }
                )
    return rows


def poses(counts: tuple[int, ...], trials: int, seed: int = 0) -> Rows:
    """Root mean square errors over trials; ``failed`` counts the trials without a solution."""
    rows = []
    x, y = simulated.CAMERA_IN_HAND, simulated.TARGET_IN_BASE
    methods: dict[str, Callable[[Samples], Any]] = {name: partial(solve, method=name) for name in METHODS}
    methods[REFINED] = methods[PLANNED] = lambda samples: refine(samples).x
    for count in counts:
        errors: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
        bounds: dict[str, list[tuple[float, float]]] = {name: [] for name in methods}
        spent = dict.fromkeys(methods, 0.0)
        for trial in range(trials):
            rng = np.random.default_rng([seed, 2, count, trial])
            of = {"random": _samples(simulated.random_hands(count, rng), rng), "planned": _proposed_hands(count, rng)}
            for name, method in methods.items():
                exact, samples = of["planned" if name == PLANNED else "random"]
                bounds[name].append(cramer_rao_bound(exact, x, y, _NOISE))
                begun = time.process_time()
                try:
                    found = method(samples)
                    errors[name].append((angle_deg(found, x), distance_mm(found, x)))
                except CalibrationError:
                    pass
                spent[name] += time.process_time() - begun
        for name in methods:
            (deg, mm), (deg_std, mm_std) = rms(np.reshape(errors[name], (-1, 2)))
            least = np.sqrt(np.mean(np.square(bounds[name]), axis=0))
            rows.append(
                {
                    "poses": count,
                    "method": name,
                    "trials": trials,
                    "rms_mm": float(mm),
                    "rms_mm_std": float(mm_std),
                    "bound_mm": float(least[1]),
                    "rms_deg": float(deg),
                    "rms_deg_std": float(deg_std),
                    "bound_deg": float(least[0]),
                    "failed": trials - len(errors[name]),
                    "ms": spent[name] / trials * 1e3,
                }
            )
    return rows


def rms(errors: Array) -> tuple[Array, Array]:
    """Root mean squares (K,) of the columns of (N, K), and their standard deviations from the scatter of the
    squares; nan if there are too few rows."""
    squares = np.square(errors)
    count = len(squares)
    nothing = np.full(squares.shape[1], np.nan)
    found = np.sqrt(squares.mean(axis=0)) if count else nothing
    if count < 2:
        return found, nothing
    # d sqrt(m) = dm / (2 sqrt(m)); a mean of N squares deviates by their own deviation / sqrt(N).
    deviation = squares.std(axis=0, ddof=1) / np.sqrt(count)
    return found, np.divide(deviation, 2.0 * found, out=np.zeros_like(found), where=found > 0.0)


def _samples(hands: Array, rng: np.random.Generator) -> tuple[Samples, Samples]:
    """Exact samples, and the same with arm noise."""
    targets = simulated.observed_targets(hands)
    return Samples(hands, targets), Samples(simulated.add_noise(hands, rng, *_NOISE), targets)


def _proposed_hands(count: int, rng: np.random.Generator) -> tuple[Samples, Samples]:
    """The same for hand poses that follow the session's proposals after the first four."""
    hands = simulated.random_hands(min(count, 4), rng)
    middle = (inverse(simulated.TARGET_IN_BASE) @ np.append(simulated.TARGET_MIDDLE, 1.0))[:3]
    while len(hands) < count:
        so_far = Samples(hands, simulated.observed_targets(hands))
        proposed = propose_pose(so_far, simulated.CAMERA_IN_HAND, simulated.TARGET_IN_BASE, _NOISE, middle, rng)
        hands = np.concatenate([hands, proposed[None]])
    return _samples(hands, rng)


def offset(trials: int, durations_s: tuple[float, ...], seed: int = 0) -> Rows:
    """Time offset errors, for a noisy arm at 125 Hz, a noisy detector at 15 Hz and true offsets up to 1 s."""
    rows = []
    for speed in (0.05, 0.1, 0.25):
        for duration_s in durations_s:
            errors, coarse, said, mm, spent = [], [], [], [], 0.0
            failed = 0
            for trial in range(trials):
                rng = np.random.default_rng([seed, 3, int(duration_s), int(speed * 1000), trial])
                true_s = float(rng.uniform(-1.0, 1.0))
                hand, target = streams(simulated.Sweep(speed), duration_s, true_s, rng)
                begun = time.process_time()
                try:
                    found = calibrate_streams(hand, target, EYE_IN_HAND)
                except CalibrationError:
                    failed += 1
                    continue
                spent += time.process_time() - begun
                errors.append(found.offset_s - true_s)
                coarse.append(found.coarse_s - true_s)
                said.append(found.std_s)
                mm.append(distance_mm(found.refined.x, simulated.CAMERA_IN_HAND))
            rows.append(
                {
                    "speed_m_per_s": speed,
                    "seconds": duration_s,
                    "failed": failed,
                    "coarse_ms": _rms_ms(coarse),
                    "error_ms": _rms_ms(errors),
                    "said_std_ms": _rms_ms(said),
                    "camera_mm": float(np.sqrt(np.mean(np.square(mm)))) if mm else float("nan"),
                    "cpu_s": spent / max(1, len(errors)),
                }
            )
    return rows


def streams(sweep: simulated.Sweep, seconds: float, offset_s: float, rng: np.random.Generator) -> tuple[Track, Track]:
    """Hand track at 125 Hz and target track at 15 Hz, both noisy, with ``offset_s`` between their stamps."""
    hand_s = np.arange(0.0, seconds, 1 / 125.0)
    seen_s = np.arange(0.1, seconds - 0.1, 1 / 15.0) + float(rng.uniform(0.0, 0.05))
    hands = simulated.add_noise(sweep.hands(hand_s), rng, *_NOISE)
    targets = simulated.observed_targets(sweep.hands(seen_s))
    targets = simulated.add_noise(targets, rng, _DETECTION_RAD, _DETECTION_M)
    hand_ns = np.round((hand_s + offset_s) * 1e9).astype(np.int64)
    seen_ns = np.round(seen_s * 1e9).astype(np.int64)
    return Track(hand_ns, hands), Track(seen_ns, targets)


def plot(pairing_rows: Rows, poses_rows: Rows, path: Path) -> None:
    """Plot the pairing and poses tables. Raises PlotError."""
    speeds = sorted({r["speed_m_per_s"] for r in pairing_rows})
    speed = speeds[len(speeds) // 2]
    with picture(path, 1, 2, size=(11, 4)) as ((left, right),):
        for name in INTERPOLATIONS:
            chosen = [r for r in pairing_rows if r["pairing"] == name and r["speed_m_per_s"] == speed]
            left.loglog([r["arm_period_ms"] for r in chosen], [r["mm_p95"] for r in chosen], "o-", label=name)
        left.set(xlabel="the arm's period (ms)", ylabel="camera's place, 95 % (mm)", title=f"at {speed:g} m/s")
        left.legend()
        for name in (*ALL_METHODS, PLANNED):
            chosen = [r for r in poses_rows if r["method"] == name]
            counts = [r["poses"] for r in chosen]
            right.loglog(counts, [r["rms_mm"] for r in chosen], "o-", label=name)
            if name in (REFINED, PLANNED):
                right.loglog(counts, [r["bound_mm"] for r in chosen], "k--", linewidth=0.8)
        right.set_xticks([4, 6, 10, 20, 50], ["4", "6", "10", "20", "50"], minor=False)
        right.set_xticks([], minor=True)
        right.set(xlabel="poses", ylabel="camera in hand, rms (mm)", title="arm noise .5 mm, .002 rad (dashed: bounds)")
        right.legend()


def _rms_ms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) * 1e3 if values else float("nan")
