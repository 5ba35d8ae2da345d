"""Pose errors by rate, gap and speed, on a simulated arm whose truth is known."""

from __future__ import annotations

import csv
import itertools
import json

import cv2
import pytest

from camera_node.robot.arm import pose_error as measuring
from camera_node.robot.arm.pose_error import PoseError, by_gap_and_speed, by_rate, format_gaps, measure
from camera_node.robot.hand_camera import TruthClient
from tests.camera_node.robot.arm.simulated import simulated_arm, start_cli, wait_until_moving, write_cell


def made():
    """Errors of a law that is known: nearest is off by gap times speed, interpolated by a tenth of it."""
    return [
        PoseError(pairing, 20.0, gap, speed, share * gap * speed, 0.1 * share * gap * speed)
        for gap, speed, _ in itertools.product((0.5, 3.0, 20.0), (0.03, 0.3), range(10))
        for pairing, share in (("nearest", 1.0), ("interpolated", 0.1))
    ]


def test_a_gap_and_a_speed_have_the_error_of_their_own(tmp_path):
    errors = made()
    rows = by_gap_and_speed(errors)
    assert len(rows) == 2 * 3 * 2 and all(row["instants"] == 10 for row in rows)
    for row in rows:
        expected = row["gap_ms"] * row["m_per_s"] * (1.0 if row["pairing"] == "nearest" else 0.1)
        assert row["median_mm"] == pytest.approx(expected) == 10 * row["median_deg"]
        assert row["gap_ms_from"] <= row["gap_ms"] < row["gap_ms_to"]
        assert row["m_per_s_from"] <= row["m_per_s"] < row["m_per_s_to"]
    table = format_gaps(rows).splitlines()
    assert len(table) == 2 + 6
    assert "6.000 / 0.600" in table[-1] and table[-1].split()[:4] == ["16", "to", "32", "ms"]
    measuring.write(by_rate(errors), rows, tmp_path)
    with (tmp_path / "gaps.csv").open() as file:
        assert len(list(csv.DictReader(file))) == len(rows)
    assert cv2.imread(str(tmp_path / "gaps.png")) is not None


def test_a_cell_of_a_few_instants_is_not_shown():
    few = [PoseError("nearest", 20.0, 5.0, 0.3, 1.0, 0.1)] * (measuring.MIN_INSTANTS - 1)
    assert by_gap_and_speed(few) == [] and "-" in format_gaps([])
    assert len(by_gap_and_speed([*few, few[0]])) == 1


@pytest.mark.slow
def test_a_standing_arm_has_no_error_whatever_the_pairing(tmp_path, capsys, host):
    with simulated_arm(host):
        assert measuring.main([str(write_cell(tmp_path, host)), "--seconds", "0.6", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["speed"]["most_m_per_s"] == 0.0 and found["gaps"] == []
    kinds = {(row["pairing"], row["rate_hz"]) for row in found["rates"]}
    assert kinds >= {("interpolated", 125.0), ("nearest", 20.0)}
    assert all(row["p95_mm"] < 1e-9 and row["instants"] >= 1 for row in found["rates"])


@pytest.mark.slow
def test_a_moving_arms_nearest_pose_is_off_by_gap_times_speed(tmp_path, host):
    file = write_cell(tmp_path, host, {"speed_rad_s": 1.5, "acceleration_rad_s2": 4.0})
    with simulated_arm(host):
        driver = start_cli("drive-arm", file)
        try:
            wait_until_moving(TruthClient(host), driver)
            rows = by_gap_and_speed(measure(str(file), 15.0))
        finally:
            driver.kill()
            driver.communicate()
    wide = {(r["pairing"], r["m_per_s_from"]): r for r in rows if r["gap_ms_from"] == 16.0}
    fast = [speed for pairing, speed in wide if pairing == "nearest" and speed >= 0.1]
    assert fast
    for speed in fast:
        nearest = wide["nearest", speed]
        assert nearest["median_mm"] == pytest.approx(nearest["gap_ms"] * nearest["m_per_s"], rel=0.4)
        if ("interpolated", speed) in wide:
            assert wide["interpolated", speed]["median_mm"] < 0.5 * nearest["median_mm"]
