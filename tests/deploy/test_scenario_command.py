"""``freshfield scenario``: what it lists, writes, checks and describes; every shipped one is valid."""

import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import pytest

from camera_node.settings import LiveConfig, source_config
from camera_node.sources.registry import open_sources
from freshfield import plugins
from freshfield.scenario import SCENARIO_FOLDER, load
from freshfield.untrusted import read_yaml
from freshfield_up.cli import main
from freshfield_up.keys import schema
from freshfield_up.scenario_command import checked
from tests.conftest import data_dir
from tests.support import refusal

OWN = Path(__file__).parent.parent / "integration/own_classes.py"
SHIPPED = sorted(SCENARIO_FOLDER.glob("*.yaml"))


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(words) == 0
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    said = refusal(capsys, main, *words)
    assert said.startswith("freshfield: ")
    return said


def test_the_list_names_each_shipped_scenario_and_the_data_that_it_needs(capsys):
    lines = {line.split()[0]: line for line in printed(capsys, "scenario", "list").splitlines()}
    assert list(lines) == [file.stem for file in SHIPPED]
    assert "[--data: fox]" in lines["fox"] and "--data" not in lines["room"]


@pytest.mark.parametrize("name", ["card", "videos"])
def test_a_file_of_ones_own_starts_as_a_shipped_one_and_is_valid(name, tmp_path, capsys):
    mine = tmp_path / "new" / "mine.yaml"
    said = printed(capsys, "scenario", "init", str(mine), "--like", name)
    step = "camera-node calibrate rig" if name == "videos" else f"freshfield scenario check {mine}"
    assert f"next: {step}" in said
    text = printed(capsys, "scenario", "show", str(mine))
    assert '\nname: "mine"\n' in text and text.count("\n") == printed(capsys, "scenario", "show", name).count("\n")
    assert "valid" in printed(capsys, "scenario", "check", str(mine))
    assert "exists" in refused(capsys, "scenario", "init", str(mine))
    assert mine.read_text() == text
    assert "expected a name" in refused(capsys, "scenario", "init", str(tmp_path / "a: b.yaml"))
    number = tmp_path / "plain" / "123.yaml"  # which YAML would not read as text
    printed(capsys, "scenario", "init", str(number), "--like", "quad")
    assert "valid" in printed(capsys, "scenario", "check", str(number))
    (tmp_path / "card").mkdir()
    assert "card: exists" in refused(capsys, "scenario", "init", str(tmp_path / "third.yaml"), "--like", "card")
    assert not (tmp_path / "third.yaml").exists()


def test_check_reads_every_section(tmp_path, capsys):
    for section, wrong in (
        ("source: {kind: mcap, file: a.mcap}", "cameras.phase: spread is for source.kind world alone"),
        ("source: {kind: world, scene: castle}", "source: .*castle"),
        ("source: {kind: world, effects: {OWN:Darker: {counts: 256}}}", "Darker.counts: expected .*0 to 255, got 256"),
        ("source: {kind: OWN:Turning, level: 256}", "source.level: expected .*0 to 255, got 256"),
        ("edge: {policy: {name: freshest-k, value: 0.5}}", "edge.policy: k: expected a whole number"),
        ("edge: {field: OWN:Flat, field_options: {level: 2}}", "edge.field: flat.level: expected .*0 to 1, got 2"),
        ("channel: {faults: {rain: 1}}", "channel.faults.rain"),
        ("edge: {update_ms: 1}", "edge.update_ms"),
    ):
        file = tmp_path / "mine.yaml"
        source = "" if section.startswith("source") else "source: {kind: world, scene: room}\n"
        file.write_text(f"cameras: {{count: 4, phase: spread}}\n{source}{section.replace('OWN', str(OWN))}\n")
        assert re.search(wrong, refused(capsys, "scenario", "check", str(file)))


@pytest.mark.parametrize(
    ("section", "name", "line"),
    [
        ("source", "Turning", "level                  default 40; 0 to 255; of the first frame"),
        ("effects", "Darker", "counts                 default 20; 0 to 255; of 255"),
        ("faults", "Late", "ms                     default 10.0; 0 to 10000; added to each delay"),
        ("edge", "Flat", "level                  default 0.5; gray"),
        ("edge", "Youngest", "value                  default 1; k"),
    ],
)
def test_options_of_plug_ins_are_keys_named_or_installed(section, name, line, capsys, monkeypatch):
    assert line in printed(capsys, "scenario", "keys", section, f"{OWN}:{name}")
    own = {"Turning": "source", "Darker": "effect", "Late": "fault", "Flat": "field", "Youngest": "policy"}[name]
    found = plugins.find(own, f"{OWN}:{name}", ())
    entries = [SimpleNamespace(name="mine", load=lambda: found), EntryPoint("broken", "no_such_module:Mine", "")]
    monkeypatch.setattr(plugins, "entry_points", lambda group: entries if group == f"freshfield.{own}" else [])
    everything = printed(capsys, "scenario", "keys", section)
    assert line in everything and "mine" in everything and "broken" not in everything
    assert line in printed(capsys, "scenario", "keys", section, "mine")
    assert "no_such_module" in refused(capsys, "scenario", "keys", section, "broken")
    if name == "Late":
        ours = jsonschema.Draft202012Validator(schema())
        for value, valid in ((1, True), (-1, False)):
            faults = {"channel": {"faults": {"mine": {"ms": value}}}}
            assert ours.is_valid({"cameras": {"count": 2}, "source": {"kind": "world"}, **faults}) == valid


def test_the_schema_takes_what_ships_and_knows_kinds_bounds_and_short_notation():
    found = json.loads(json.dumps(schema()))
    jsonschema.Draft202012Validator.check_schema(found)
    validator = jsonschema.Draft202012Validator(found)
    for file in SHIPPED:
        validator.validate(read_yaml(file.read_text()))

    def valid(**sections: Any) -> bool:
        return validator.is_valid({"cameras": {"count": 4}, "source": {"kind": "world"}, **sections})

    assert valid() and not valid(unknown={}) and not valid(cameras={"count": 4, "unknown": 1})
    assert valid(source={"kind": "mine.py:Mine", "anything": 1}) and valid(channel={"faults": {"mine.py:Late": {}}})
    assert valid(edge={"field_options": {"layers": True}}) and not valid(edge={"field_options": {"lairs": True}})
    assert not valid(edge={"field": "ngp", "field_options": {"layers": True}})
    assert valid(channel={"service": "exp:60ms", "faults": {"loss": 0.1}}) and valid(edge=None)
    assert valid(source={"kind": "realsense", "width": 640}) and not valid(source={"kind": "world", "iso": 400})
    assert not valid(edge={"update_ms": 1}) and not valid(cameras={"count": -1})


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_every_package_accepts_its_section(file):
    scenario = load(file)
    assert scenario.name == file.stem, "a report names the scenario: it must lead back to the file"
    assert scenario.description
    source = source_config(scenario)
    arm = getattr(source, "arm", None)
    # A scene needs views from several sides: of several cameras, of two that measure depth, or of one that an arm or
    # somebody carries round it.
    depth = "depth_sensor" in source.effects or source.kind in ("oak", "realsense")
    least = 1 if scenario.held_out_every else 2 if depth else 3
    assert len(scenario.training) >= least or set(arm.cameras) >= set(scenario.training)
    assert checked(scenario)


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_every_camera_has_a_first_image(file):
    scenario = load(file)
    config = source_config(scenario)
    if isinstance(config, LiveConfig):
        pytest.skip("needs cameras: tests/camera_node/sources/devices has them")
    if getattr(config, "arm", None) is not None:
        pytest.skip("needs an arm: tests/camera_node/robot/simulated_controller has one")
    folder = getattr(config, "data", "")
    data = data_dir(folder.split("/")[0]).parent if folder else None
    # One trained and one held-out camera: a world takes a while to prepare each.
    cameras = [scenario.training[0], *scenario.held_out[:1]]
    sources = open_sources(scenario, config, cameras, data)
    assert set(sources) == set(cameras)
    for source in sources.values():
        shot = source.read(source.content(0))
        assert (shot.intrinsics.width, shot.intrinsics.height) == (source.intrinsics.width, source.intrinsics.height)
