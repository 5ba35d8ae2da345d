"""Measures the error of hand poses from joint states while a simulated arm moves.

    camera-node simulate-arm cell & camera-node drive-arm cell &
    python -m camera_node.robot.arm.pose_error cell [--seconds 45] [--out DIR] [--json]

At random instants it compares the pose of the hand with the simulated controller's true one: from the nearest
joint state and interpolated, at several rates of joint states, all in the same run. It reports the errors by
rate, and by gap to the nearest joint state and speed of the hand. An arm that stops at viewpoints has all
speeds up to its fastest (``source.arm.path.speed_rad_s``).
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.pose.providers import PoseGapError
from camera_node.robot import figures
from camera_node.robot.arm.camera_poses import arm_model, base_matrix
from camera_node.robot.arm.joint_states import ArmStream, HandPoses
from camera_node.robot.hand_camera import TruthClient
from camera_node.robot.simulated_controller.command import require_arm
from freshfield.clock import WallClock
from freshfield.files import write_csv
from freshfield.geometry import so3_log
from freshfield.scenario import load

RATES_HZ = (500.0, 125.0, 20.0)
PAIRINGS = ("nearest", "interpolated")
GAPS_MS = (0.0, 1.0, 2.0, 4.0, 8.0, 16.0, 32.0)
SPEEDS_M_PER_S = (0.01, 0.05, 0.1, 0.2, 0.4, 1.6)
MIN_INSTANTS = 5  # for a median to be shown
_SETTLE_S = 0.1  # even at the lowest rate, the sample after an instant arrives within this time
_SPEED_OVER_NS = 5_000_000
_WINDOW_S, _INSTANTS = 0.2, 6  # so many instants are examined together

Row = dict[str, Any]


@dataclass(frozen=True)
class PoseError:
    """Error of one stream's pose at one instant.

    gap_ms: time to the nearest joint state.
    speed_m_per_s: of the hand at that instant.
    mm, deg: error in position and rotation.
    """

    pairing: str
    rate_hz: float
    gap_ms: float
    speed_m_per_s: float
    mm: float
    deg: float


def measure(scenario: str, seconds: float) -> list[PoseError]:
    """The errors at every instant and of every stream. Raises ScenarioError, ArmError and PoseGapError."""
    plan = load(scenario)
    config = require_arm(plan)
    model, base = arm_model(plan, config), base_matrix(config)
    clock, truth = WallClock(), TruthClient(config.host)
    streams = {
        (pairing, rate): ArmStream(config.host, clock, rate, pairing == "interpolated", max_gap_ms=200.0)
        for rate in RATES_HZ
        for pairing in PAIRINGS
    }
    errors = []
    rng = np.random.default_rng(0)
    try:
        for stream in streams.values():
            stream.start()
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            begin_ns = clock.now_ns()
            time.sleep(_WINDOW_S + _SETTLE_S)
            for after_ns in np.sort(rng.uniform(0.0, _WINDOW_S * 1e9, _INSTANTS)):
                t_ns = begin_ns + int(after_ns)
                true = base @ model.forward(truth.joints(t_ns))
                before = base @ model.forward(truth.joints(t_ns - _SPEED_OVER_NS))
                speed = float(np.linalg.norm(true[:3, 3] - before[:3, 3])) / (_SPEED_OVER_NS * 1e-9)
                for (pairing, rate), stream in streams.items():
                    try:
                        pose, gap_ns = HandPoses(stream, model, base, 0.0).at(t_ns)
                    except PoseGapError:
                        continue  # a node would not send this frame
                    claimed = pose.matrix()
                    mm = 1e3 * float(np.linalg.norm(true[:3, 3] - claimed[:3, 3]))
                    deg = float(np.rad2deg(np.linalg.norm(so3_log(true[:3, :3].T @ claimed[:3, :3]))))
                    errors.append(PoseError(pairing, rate, gap_ns / 1e6, speed, mm, deg))
    finally:
        for stream in streams.values():
            stream.stop()
    return errors


def by_rate(errors: Sequence[PoseError]) -> list[Row]:
    """Errors by rate of joint states and pairing, at all speeds: median and 95th percentile."""
    rows = []
    for rate, pairing in itertools.product(RATES_HZ, PAIRINGS):
        chosen = [e for e in errors if e.rate_hz == rate and e.pairing == pairing]
        if chosen:
            rows.append({"pairing": pairing, "rate_hz": rate, **_statistics(chosen)})
    return rows


def by_gap_and_speed(errors: Sequence[PoseError]) -> list[Row]:
    """Errors by pairing, gap and speed, over all rates. Cells with fewer than five instants are left out."""
    rows = []
    gaps, speeds = itertools.pairwise(GAPS_MS), itertools.pairwise(SPEEDS_M_PER_S)
    for pairing, gap, speed in itertools.product(PAIRINGS, gaps, speeds):
        chosen = [
            e
            for e in errors
            if e.pairing == pairing and gap[0] <= e.gap_ms < gap[1] and speed[0] <= e.speed_m_per_s < speed[1]
        ]
        if len(chosen) >= MIN_INSTANTS:
            rows.append({
                "pairing": pairing, "gap_ms_from": gap[0], "gap_ms_to": gap[1],
                "m_per_s_from": speed[0], "m_per_s_to": speed[1],
                "gap_ms": float(np.median([e.gap_ms for e in chosen])),
                "m_per_s": float(np.median([e.speed_m_per_s for e in chosen])),
                **_statistics(chosen),
            })  # fmt: skip
    return rows


def _statistics(errors: Sequence[PoseError]) -> dict[str, float]:
    mm, deg = [e.mm for e in errors], [e.deg for e in errors]
    return {
        "instants": float(len(errors)),
        "median_mm": float(np.median(mm)), "p95_mm": float(np.percentile(mm, 95)),
        "median_deg": float(np.median(deg)), "p95_deg": float(np.percentile(deg, 95)),
    }  # fmt: skip


def format_rates(rows: Sequence[Row]) -> str:
    """``by_rate`` as text."""
    lines = [f"{'':26} {'mm: median':>11} {'p95':>7} {'degrees: median':>16} {'p95':>7}"]
    lines += [
        f"{row['pairing']} at {row['rate_hz']:g} Hz".ljust(26)
        + f" {row['median_mm']:11.3f} {row['p95_mm']:7.3f} {row['median_deg']:16.4f} {row['p95_deg']:7.4f}"
        for row in rows
    ]
    return "\n".join(lines)


def format_gaps(rows: Sequence[Row]) -> str:
    """``by_gap_and_speed`` as text: medians in mm, a line a gap, a column a speed, nearest / interpolated."""
    cell = {(r["pairing"], r["gap_ms_from"], r["m_per_s_from"]): f"{r['median_mm']:.3f}" for r in rows}
    ranges = [f"{a:g} to {b:g} m/s" for a, b in itertools.pairwise(SPEEDS_M_PER_S)]
    lines = ["median mm, nearest / interpolated", f"{'gap':>14}" + "".join(f"{each:>18}" for each in ranges)]
    for low, high in itertools.pairwise(GAPS_MS):
        pairs = (
            " / ".join(cell.get((pairing, low, speed), "-") for pairing in PAIRINGS)
            for speed in SPEEDS_M_PER_S[:-1]
        )
        lines.append(f"{f'{low:g} to {high:g} ms':>14}" + "".join(f"{each:>18}" for each in pairs))
    return "\n".join(lines)


def write(rates: Sequence[Row], gaps: Sequence[Row], folder: Path) -> None:
    """Write both tables as CSV, and plot the second if matplotlib is installed. Raises OSError."""
    write_csv(folder / "rates.csv", rates)
    write_csv(folder / "gaps.csv", gaps)
    plt = figures.pyplot()
    if not gaps or plt is None:
        return
    figure, panels = plt.subplots(1, 2, figsize=(11, 4), layout="constrained", sharex=True, sharey=True)
    for pairing, panel in zip(PAIRINGS, panels):
        for k, (low, high) in enumerate(itertools.pairwise(GAPS_MS)):
            chosen = [r for r in gaps if r["pairing"] == pairing and r["gap_ms_from"] == low]
            speeds = [r["m_per_s"] for r in chosen]
            label = f"{low:g} to {high:g} ms"
            panel.loglog(speeds, [r["median_mm"] for r in chosen], "o-", color=f"C{k}", label=label)
        panel.set(title=pairing, xlabel="speed of the hand (m/s)")
        panel.set_xticks([], minor=True)
        panel.set_xticks([0.03, 0.1, 0.3, 1.0], ["0.03", "0.1", "0.3", "1"])
    panels[0].set(ylabel="hand's place, median (mm)")
    panels[1].legend(title="gap to the nearest joint state")
    figure.savefig(folder / "gaps.png", dpi=110)
    plt.close(figure)


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m camera_node.robot.arm.pose_error", description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )  # fmt: skip
    parser.add_argument("scenario", help="a scenario whose simulated arm is running and moving")
    parser.add_argument("--seconds", type=float, default=45.0)
    parser.add_argument("--out", type=Path, metavar="DIR", help="tables as CSV, and a picture")
    parser.add_argument("--json", action="store_true", help="for scripts")
    args = parser.parse_args(arguments)
    try:
        errors = measure(args.scenario, args.seconds)
        rates, gaps = by_rate(errors), by_gap_and_speed(errors)
        if args.out is not None:
            write(rates, gaps, args.out)
    except (ValueError, OSError) as error:
        print(f"measure: {error}", file=sys.stderr)
        return 2
    speeds = [e.speed_m_per_s for e in errors] or [0.0]
    median, most = float(np.median(speeds)), float(np.max(speeds))
    if args.json:
        speed = {"median_m_per_s": median, "most_m_per_s": most}
        print(json.dumps({"speed": speed, "rates": rates, "gaps": gaps}, indent=1))
    else:
        print(f"the flange moves at {median:.3f} m/s (median), {most:.3f} at most")
        print(f"{format_rates(rates)}\n\n{format_gaps(gaps)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
