"""The files for a bench are what the programs accept; ``test_docs`` has the guide itself."""

import re
import shlex
import shutil
import subprocess

import pytest

from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.tour_planning import plan_tour, viewpoints
from camera_node.settings import source_config
from freshfield.scenario import load
from freshfield_up.scenario_command import checked
from tests.conftest import ROOT
from tests.deploy.test_docs import help_of

LAB = ROOT / "deploy" / "lab"
UNITS = sorted((LAB / "systemd").glob("*.service"))


def test_the_example_bench_is_a_scenario_whose_arm_reaches_its_tour():
    scenario = load(LAB / "bench-example.yaml")
    config = source_config(scenario)
    assert checked(scenario)
    mount = load_hand_eyes(scenario, config.arm, scenario.cameras)["hand"].transform
    found = plan_tour(arm_model(scenario, config.arm), base_matrix(config.arm), mount, config.arm.path)
    assert found.reached >= 0.8 * len(viewpoints(config.arm.path))
    assert not config.arm.simulated


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_units_call_the_programs_with_options_they_have_confined_to_a_folder_of_their_own(unit):
    text = unit.read_text().replace("\\\n", " ")
    words = shlex.split(re.search(r"^ExecStart=(.*)$", text, re.M)[1])
    program, command = words[0].rsplit("/", 1)[1], words[1]
    known = set(re.findall(r"--[a-z-]+", help_of(program, command)))
    assert {word for word in words if word.startswith("--")} <= known
    settings = re.findall(r"^(\w+)=", (LAB / "systemd" / "bench.env").read_text(), re.M)
    assert set(re.findall(r"\$\{(\w+)\}", text)) <= set(settings)
    assert "EnvironmentFile=/etc/freshfield/bench.env" in text and "WantedBy=" in text
    assert command != "drive-arm", "nothing starts an arm by itself"

    own = {re.search(r"--out %S/(\S+)", text)[1], re.search(r"^StateDirectory=(.*)$", text, re.M)[1]}
    assert len(own) == 1 and "ProtectSystem=strict" in text and "ReadWritePaths" not in text
    if shutil.which("systemd-analyze") is not None:
        command = ["systemd-analyze", "security", "--offline=true", "--threshold=39", str(unit)]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60)
        assert done.returncode == 0, done.stdout[-200:]
