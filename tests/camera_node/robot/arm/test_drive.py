"""``camera-node drive-arm`` with the real control interface and a simulated arm."""

from __future__ import annotations

import signal
import socket
import time

import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.viewpoint_tour import plan_tour
from camera_node.robot.flange_camera import TruthClient
from camera_node.robot.simulated_controller.controller import HOME_RAD
from camera_node.settings import source_config
from freshfield.clock import WallClock
from freshfield.scenario import load
from tests.camera_node.robot.arm.simulated import simulated_arm, start_cli, wait_until_moving, write_cell

PATH = {
    "azimuths_deg": [-150, -120],
    "elevations_deg": [60],
    "rolls_deg": [0],
    "speed_rad_s": 3.0,
    "acceleration_rad_s2": 20.0,
}


@pytest.fixture
def cell(tmp_path, host):
    """A cell with a short and fast path: its file, its address."""
    return write_cell(tmp_path, host, PATH), host


def real(cell, **path):
    """The same cell, its arm taken for a real one: no patience, and questions."""
    file, host = cell
    return write_cell(file.parent, host, PATH | path, simulated=False)


def near(file):
    """--joints of an arm that stands some 30 degrees before the first viewpoint."""
    angles = np.add(np.rad2deg(stops_of(file)[0]), [30, 10, 0, 0, 0, 0])
    return "--joints=" + ",".join(f"{angle:.3f}" for angle in angles)


def stands_at(option):
    """Joint angles (6,) of --joints, degrees."""
    return np.array(option.removeprefix("--joints=").split(","), float)


def at_rest(truth, within_s=5.0):
    clock, until = WallClock(), time.monotonic() + within_s
    while time.monotonic() < until:
        before = truth.joints(clock.now_ns())
        time.sleep(0.1)
        if np.array_equal(truth.joints(clock.now_ns()), before):
            return True
    return False


def shown(text):
    """Joint angles (N, 6) of the numbered lines, degrees."""
    lines = [line.split() for line in text.splitlines()]
    return np.array([line[1:] for line in lines if line and line[0].isdigit() and len(line) == 7], float)


def drive(file, *options):
    # Under nohup a hang-up is ignored, and whoever is started ignores it, too.
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        return start_cli("drive-arm", file, *options)
    finally:
        signal.signal(signal.SIGHUP, before)


def stops_of(file):
    scenario = load(file)
    config = source_config(scenario).arm
    mount = load_hand_eyes(scenario, config, ["hand"])["hand"].transform
    return plan_tour(arm_model(scenario, config), base_matrix(config), mount, config.path, HOME_RAD).stops


def test_a_round_visits_every_viewpoint_and_ends(cell):
    file, host = cell
    with simulated_arm(host):
        truth, clock = TruthClient(host), WallClock()
        process = drive(file, "--rounds", "1")
        seen = []
        while process.poll() is None:
            seen.append(truth.joints(clock.now_ns()))
            time.sleep(0.005)
        said = process.communicate()
        assert process.returncode == 0, said
        np.testing.assert_allclose(shown(said[0]), np.rad2deg(stops_of(file)), atol=0.006)
        for stop in stops_of(file):
            assert min(np.abs(q - stop).max() for q in seen) < 0.02
        assert np.abs(truth.joints(clock.now_ns()) - stops_of(file)[-1]).max() < 2e-3


def test_a_drive_that_is_killed_leaves_no_arm_moving(cell):
    """The controller's own watchdog misses it."""
    file, host = cell
    with simulated_arm(host, near(file)):
        truth = TruthClient(host)
        process = drive(real(cell, speed_rad_s=0.1), "--yes")  # the first move takes many seconds
        wait_until_moving(truth, process)
        process.kill()
        process.communicate()
        assert at_rest(truth)
        assert np.abs(truth.joints(WallClock().now_ns()) - stops_of(file)[0]).max() > 0.2


def test_a_program_stopped_at_the_pendant_and_a_signal_end_the_drive(cell):
    file, host = cell
    with simulated_arm(host):
        truth = TruthClient(host)
        process = drive(file)
        wait_until_moving(truth, process)
        with socket.create_connection((host, 29999), 5.0) as dashboard:
            dashboard.sendall(b"stop\n")
            assert process.wait(20.0) == 1
        assert "its program was ended" in process.communicate()[1]
        assert at_rest(truth)
        process = drive(file)
        wait_until_moving(truth, process)
        process.send_signal(signal.SIGTERM)  # ends it in order
        assert process.wait(20.0) == 0 and at_rest(truth, 0.3)


def test_a_first_move_through_half_the_bench_is_refused(cell):
    with simulated_arm(cell[1], "--joints=-20,-90,90,-90,90,0"):
        process = drive(real(cell), "--yes")
        said = process.communicate(timeout=20)
        assert process.returncode == 2
        assert "the first move would turn a joint by" in said[1] and "with the pendant" in said[1]


def test_a_real_arm_is_asked_about_first(cell):
    file, host = cell
    with simulated_arm(host, near(file)):
        assert main(["drive-arm", str(file), "--show"]) == 0
        process = drive(real(cell))
        said = process.communicate(timeout=20)
        assert np.allclose(TruthClient(host).joints(WallClock().now_ns()), np.deg2rad(stands_at(near(file))), atol=1e-4)
        assert "say that its space is clear with --yes" in said[1]
        assert process.returncode == 2
        # Before the question, and from the nearest viewpoint on.
        stands = next(line.split()[2:] for line in said[0].splitlines() if "stands at" in line)
        first_deg = np.abs(shown(said[0])[0] - np.array(stands, float)).max()
        assert f"the first move turns a joint by {first_deg:.0f}" in said[0] and 0 < first_deg <= 30


def test_a_scenario_without_an_arm_or_a_path_is_refused(cell, capsys):
    file, _ = cell
    for words, says in ((["tile"], "source.arm: missing"), ([str(file), "--rounds", "-1"], "--rounds: expected 0")):
        assert main(["drive-arm", *words]) == 2
        assert says in capsys.readouterr().err
    data = yaml.safe_load(file.read_text())
    del data["source"]["arm"]["path"]
    file.write_text(yaml.safe_dump(data))
    assert main(["drive-arm", str(file)]) == 2
    assert "source.arm.path: missing" in capsys.readouterr().err
