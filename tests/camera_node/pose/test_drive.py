"""``camera-node drive-arm`` with the real control interface and a simulated arm."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import yaml

from camera_node.cli import main
from camera_node.config import source_config
from camera_node.pose.controller.controller import HOME_RAD
from camera_node.pose.mounted import arm_model, base_matrix, hand_eyes
from camera_node.pose.path import tour
from camera_node.sources.on_arm import Truth
from freshfield.clock import WallClock
from freshfield.scenario import load
from tests.camera_node.pose.simulated import own_address, require_ur_rtde, simulated_arm


@pytest.fixture
def cell(tmp_path):
    """A cell with a short and fast path: its file, its address."""
    data = yaml.safe_load(load("cell").path.read_text())
    arm = data["source"]["arm"]
    arm["host"] = own_address()
    arm["cameras"] = {"hand": None}
    arm["path"] |= {"azimuths_deg": [-105, -75], "elevations_deg": [50], "speed_rad_s": 3.0}
    arm["path"]["acceleration_rad_s2"] = 20.0
    file = tmp_path / "cell.yaml"
    file.write_text(yaml.safe_dump(data))
    return file, arm["host"]


def drive(file, *options):
    command = [sys.executable, "-m", "camera_node.cli", "drive-arm", str(file), *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def stops_of(file):
    scenario = load(file)
    config = source_config(scenario).arm
    mount = hand_eyes(scenario, config, ["hand"])["hand"].transform
    return tour(arm_model(scenario, config), base_matrix(config), mount, config.path, HOME_RAD)


def test_a_round_visits_every_viewpoint_and_ends(cell):
    require_ur_rtde()
    file, host = cell
    with simulated_arm(host):
        truth, clock = Truth(host), WallClock()
        process = drive(file, "--rounds", "1")
        seen = []
        while process.poll() is None:
            seen.append(truth.joints(clock.now_ns()))
            time.sleep(0.005)
        said = process.communicate()
        assert process.returncode == 0, said
        assert said[0].strip() == "3 viewpoints"
        for stop in stops_of(file):
            assert min(np.abs(q - stop).max() for q in seen) < 0.02
        assert np.abs(truth.joints(clock.now_ns()) - stops_of(file)[-1]).max() < 2e-3


@pytest.mark.slow
def test_a_signal_stops_the_arm_where_it_is(cell):
    require_ur_rtde()
    file, host = cell
    with simulated_arm(host):
        truth, clock = Truth(host), WallClock()
        start = truth.joints(clock.now_ns())
        process = drive(file)
        while np.abs(truth.joints(clock.now_ns()) - start).max() < 0.05:
            assert process.poll() is None
            time.sleep(0.01)
        process.send_signal(signal.SIGTERM)
        assert process.wait(20.0) == 0
        where = truth.joints(clock.now_ns())
        time.sleep(0.3)
        assert np.array_equal(truth.joints(clock.now_ns()), where)


@pytest.mark.slow
def test_an_arm_that_vanishes_ends_the_drive_with_one_line(cell):
    require_ur_rtde()
    file, host = cell
    data = yaml.safe_load(file.read_text())
    data["source"]["arm"]["simulated"] = False  # as with a real one: no patience
    file.write_text(yaml.safe_dump(data))
    with simulated_arm(host) as arm:
        truth, clock = Truth(host), WallClock()
        start = truth.joints(clock.now_ns())
        process = drive(file, "--yes")
        while np.abs(truth.joints(clock.now_ns()) - start).max() < 0.05:
            assert process.poll() is None, process.communicate()
            time.sleep(0.01)
        arm.kill()
        assert process.wait(30.0) == 1
        assert f"camera-node: arm at {host}" in process.communicate()[1]


def test_a_real_arm_is_asked_about_first(cell):
    require_ur_rtde()
    file, host = cell
    data = yaml.safe_load(file.read_text())
    data["source"]["arm"]["simulated"] = False
    file.write_text(yaml.safe_dump(data))
    with simulated_arm(host):
        process = drive(file)
        assert "say that its space is clear with --yes" in process.communicate(timeout=20)[1]
        assert process.returncode == 2


def test_the_tour_is_shown_without_an_arm(cell, capsys):
    file, _ = cell
    assert main(["drive-arm", str(file), "--show"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "3 viewpoints" and len(lines[1].split()) == 6


def test_a_scenario_without_an_arm_or_a_path_is_refused(cell, capsys):
    file, _ = cell
    assert main(["drive-arm", "tile"]) == 2
    assert "source.arm: missing" in capsys.readouterr().err
    data = yaml.safe_load(file.read_text())
    del data["source"]["arm"]["path"]
    file.write_text(yaml.safe_dump(data))
    assert main(["drive-arm", str(file)]) == 2
    assert "source.arm.path: missing" in capsys.readouterr().err
