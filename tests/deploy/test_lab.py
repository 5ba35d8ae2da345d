"""The guide for a bench: its files are what the programs accept, its commands exist."""

from __future__ import annotations

import re
import shlex

import pytest

from camera_node.cli import main as camera_node
from camera_node.config import source_config
from camera_node.robot.arm.camera_poses import arm_model, base_matrix, load_hand_eyes
from camera_node.robot.arm.viewpoint_tour import plan_tour, viewpoints
from channel_emu.cli import main as channel_emu
from channel_emu.model.config import channel_from_mapping
from edge_server.cli import main as edge_server
from edge_server.config import read_config
from edge_server.fields.registry import make_field
from freshfield.scenario import load
from tests.conftest import ROOT

LAB = ROOT / "deploy" / "lab"
PROGRAMS = {"camera-node": camera_node, "channel-emu": channel_emu, "edge-server": edge_server}
UNITS = sorted((LAB / "systemd").glob("*.service"))


def options_of(program: str, command: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    with pytest.raises(SystemExit) as end:
        PROGRAMS[program]([command, "--help"])
    assert end.value.code == 0
    return set(re.findall(r"--[a-z-]+", capsys.readouterr().out))


def test_the_example_bench_is_a_scenario_whose_arm_reaches_its_tour() -> None:
    scenario = load(LAB / "bench-example.yaml")
    config = source_config(scenario)
    channel_from_mapping(scenario.channel, "channel")
    edge = read_config(scenario)
    make_field(edge.field, edge.field_options, seed=scenario.seed)
    mount = load_hand_eyes(scenario, config.arm, scenario.cameras)["hand"].transform
    found = plan_tour(arm_model(scenario, config.arm), base_matrix(config.arm), mount, config.arm.path)
    assert found.reached >= 0.8 * len(viewpoints(config.arm.path))
    assert not config.arm.simulated


@pytest.mark.parametrize("unit", UNITS, ids=lambda unit: unit.stem)
def test_units_call_the_programs_with_options_they_have(unit, capsys) -> None:
    text = unit.read_text().replace("\\\n", " ")
    words = shlex.split(re.search(r"^ExecStart=(.*)$", text, re.M)[1])
    program, command = words[0].rsplit("/", 1)[1], words[1]
    assert {w for w in words if w.startswith("--")} <= options_of(program, command, capsys)
    settings = dict(
        line.split("=", 1) for line in (LAB / "systemd" / "bench.env").read_text().splitlines() if "=" in line
    )
    assert set(re.findall(r"\$\{(\w+)\}", text)) <= set(settings)
    assert "EnvironmentFile=/etc/freshfield/bench.env" in text and "WantedBy=" in text


def test_nothing_starts_an_arm_by_itself() -> None:
    assert UNITS and not any("drive-arm" in re.sub("#.*", "", unit.read_text()) for unit in UNITS)


def test_the_guides_commands_exist(capsys) -> None:
    text = re.sub(r"\n {3}(?! )", " ", (LAB / "README.md").read_text())  # lines of one item
    found = re.findall(r"\b(camera-node|channel-emu|edge-server) ([a-z-]+)((?: [^\n`#|]+)?)", text)
    assert len(found) >= 8
    for program, command, rest in found:
        known = options_of(program, command, capsys)
        if command == "calibrate":
            with pytest.raises(SystemExit):
                camera_node([command, rest.split()[0], "--help"])
            known = set(re.findall(r"--[a-z-]+", capsys.readouterr().out))
        assert set(re.findall(r"(--[a-z][a-z-]*)(?!\*)", rest)) <= known, (program, command, rest)


def test_every_file_that_the_guide_names_is_there() -> None:
    text = (LAB / "README.md").read_text()
    for name in re.findall(r"deploy/(?:lab|scenarios)/[\w./@*-]+", text):
        assert list(ROOT.glob(name.rstrip("."))), name
