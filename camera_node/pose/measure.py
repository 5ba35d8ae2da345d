"""How far the poses that an arm's joint states give are from the truth, while a simulated arm moves.

    camera-node simulate-arm cell & camera-node drive-arm cell &
    python -m camera_node.pose.measure cell [--seconds 45] [--json]

At random instants the pose of the hand is compared with where the simulated controller says that it really
was: nearest joint state and interpolated, at several rates of joint states, all in the same run.
"""

from __future__ import annotations

import argparse
import json
import sys
import time

import numpy as np

from camera_node.pose.arm import ArmStream, HandPoses
from camera_node.pose.controller.command import arm_of
from camera_node.pose.mounted import arm_model, base_matrix
from camera_node.pose.rig import PoseGapError
from camera_node.sources.on_arm import Truth
from freshfield.clock import WallClock
from freshfield.geometry import so3_log
from freshfield.scenario import load

RATES_HZ = (500.0, 125.0, 20.0)
_LATER_S = 0.1  # by when the sample after an instant has come even at the lowest rate
_SPEED_OVER_NS = 5_000_000


def measure(scenario: str, seconds: float, seed: int = 0) -> dict[str, dict[str, float]]:
    """Errors by pairing and rate: mm and degrees, median and 95th percentile; the hand's speed (m/s) under
    ``speed``. Raises ScenarioError, ArmError, PoseGapError."""
    plan = load(scenario)
    config = arm_of(plan)
    model, base, clock, truth = arm_model(plan, config), base_matrix(config), WallClock(), Truth(config.host)
    streams = {
        f"{'interpolated' if interpolate else 'nearest'} at {rate:g} Hz": ArmStream(
            config.host, clock, rate, interpolate, max_gap_ms=200.0
        )
        for rate in RATES_HZ
        for interpolate in (True, False)
    }
    errors: dict[str, list[tuple[float, float]]] = {name: [] for name in streams}
    speeds = []
    rng = np.random.default_rng(seed)
    try:
        for stream in streams.values():
            stream.start()
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            time.sleep(rng.uniform(0.05, 0.1))
            now_ns = clock.now_ns()
            time.sleep(_LATER_S)
            true = base @ model.forward(truth.joints(now_ns))
            before = base @ model.forward(truth.joints(now_ns - _SPEED_OVER_NS))
            speeds.append(float(np.linalg.norm(true[:3, 3] - before[:3, 3])) / (_SPEED_OVER_NS * 1e-9))
            for name, stream in streams.items():
                try:
                    claimed = HandPoses(stream, model, base, 0.0).at(now_ns).pose.matrix()
                except PoseGapError:
                    continue  # it would not be sent either
                apart_mm = 1e3 * float(np.linalg.norm(true[:3, 3] - claimed[:3, 3]))
                turned = so3_log(true[:3, :3].T @ claimed[:3, :3])
                errors[name].append((apart_mm, float(np.rad2deg(np.linalg.norm(turned)))))
    finally:
        for stream in streams.values():
            stream.stop()
    found = {"speed": {"median_m_per_s": float(np.median(speeds)), "most_m_per_s": float(np.max(speeds))}}
    for name, pairs in errors.items():
        if pairs:
            mm, deg = np.array(pairs).T
            found[name] = {
                "instants": float(len(pairs)),
                "median_mm": float(np.median(mm)),
                "p95_mm": float(np.percentile(mm, 95)),
                "median_deg": float(np.median(deg)),
                "p95_deg": float(np.percentile(deg, 95)),
            }
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m camera_node.pose.measure", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("scenario", help="a scenario whose simulated arm is running and moving")
    parser.add_argument("--seconds", type=float, default=45.0)
    parser.add_argument("--json", action="store_true", help="for scripts")
    args = parser.parse_args(arguments)
    try:
        found = measure(args.scenario, args.seconds)
    except ValueError as error:
        print(f"measure: {error}", file=sys.stderr)
        return 2
    if args.json:
        print(json.dumps(found, indent=1))
        return 0
    speed = found.pop("speed")
    print(
        f"the flange moves at {speed['median_m_per_s']:.3f} m/s (median), {speed['most_m_per_s']:.3f} at most"
    )
    print(f"{'':26} {'mm: median':>11} {'p95':>7} {'degrees: median':>16} {'p95':>7}")
    for name, row in found.items():
        print(
            f"{name:26} {row['median_mm']:11.3f} {row['p95_mm']:7.3f} {row['median_deg']:16.4f} "
            f"{row['p95_deg']:7.4f}"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
