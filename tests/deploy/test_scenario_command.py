"""``freshfield scenario``: what it lists, writes, checks and describes."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from freshfield.scenario import SCENARIO_FOLDER
from freshfield.untrusted import read_yaml
from freshfield_up.cli import main

SHIPPED = sorted(SCENARIO_FOLDER.glob("*.yaml"))


def printed(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(words) == 0
    return capsys.readouterr().out


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    assert main(words) == 2
    error = capsys.readouterr().err
    assert error.startswith("freshfield: ") and error.count("\n") == 1
    return error


def test_the_list_names_each_shipped_scenario_and_the_data_that_it_needs(capsys):
    lines = {line.split()[0]: line for line in printed(capsys, "scenario", "list").splitlines()}
    assert list(lines) == [file.stem for file in SHIPPED]
    assert "[--data: fox]" in lines["fox"] and "--data" not in lines["room"]


@pytest.mark.parametrize("name", ["quad", "card"])
def test_a_file_of_ones_own_starts_as_a_shipped_one_and_is_valid(name, tmp_path, capsys):
    mine = tmp_path / "new" / "mine.yaml"
    printed(capsys, "scenario", "init", str(mine), "--like", name)
    text = printed(capsys, "scenario", "show", str(mine))
    assert '\nname: "mine"\n' in text and text.count("\n") == printed(capsys, "scenario", "show", name).count("\n")
    assert "valid" in printed(capsys, "scenario", "check", str(mine))
    assert "exists" in refused(capsys, "scenario", "init", str(mine))
    assert mine.read_text() == text
    assert ".yaml" in refused(capsys, "scenario", "init", str(tmp_path / "mine.txt"))
    for odd in ("a: b.yaml", "x\\1.yaml"):
        assert "expected a name" in refused(capsys, "scenario", "init", str(tmp_path / odd))
    for plain in ("123.yaml", "yes.yaml"):  # that YAML would not read as text
        printed(capsys, "scenario", "init", str(tmp_path / "plain" / plain), "--like", "quad")
        assert "valid" in printed(capsys, "scenario", "check", str(tmp_path / "plain" / plain))


def test_a_folder_that_is_there_already_is_not_written_into(tmp_path, capsys):
    (tmp_path / "card").mkdir()
    assert "card: exists" in refused(capsys, "scenario", "init", str(tmp_path / "mine.yaml"), "--like", "card")
    assert not (tmp_path / "mine.yaml").exists()


@pytest.mark.parametrize(
    ("section", "wrong"),
    [
        ("source: {kind: world, scene: room, fps: fast}", "source.fps"),
        ("channel: {preset: ch7}", "channel.preset"),
        ("channel: {faults: {rain: 1}}", "channel.faults.rain"),
        ("edge: {update_ms: 1}", "edge.update_ms"),
        ("edge: {field_options: {colour: red}}", "colour"),
        ("edge: {field: fog}", "fog"),
    ],
)
def test_check_reads_every_section(section, wrong, tmp_path, capsys):
    file = tmp_path / "mine.yaml"
    source = "" if section.startswith("source") else "source: {kind: world, scene: room}\n"
    file.write_text(f"cameras: {{count: 4}}\n{source}{section}\n")
    assert wrong in refused(capsys, "scenario", "check", str(file))


def test_keys_of_a_section_and_of_all(capsys):
    everything = printed(capsys, "scenario", "keys")
    for section, key in (
        ("cameras", "held_out"),
        ("source", "source: {kind: realsense, ...}"),
        ("effects", "sensor_noise (acts on: image)"),
        ("channel", "channel.service"),
        ("faults", "probability"),
        ("edge", "edge.field_options of field splat"),
    ):
        part = printed(capsys, "scenario", "keys", section)
        assert key in part and part.strip() in everything
    assert "there are: cameras" in refused(capsys, "scenario", "keys", "camera")


@pytest.fixture(scope="module")
def validator() -> Any:
    from freshfield_up.keys import schema

    found = json.loads(json.dumps(schema()))
    jsonschema.Draft202012Validator.check_schema(found)
    return jsonschema.Draft202012Validator(found)


@pytest.mark.parametrize("file", SHIPPED, ids=lambda file: file.stem)
def test_the_schema_takes_what_ships_and_no_unknown_key(file: Path, validator: Any) -> None:
    data = read_yaml(file.read_text())
    validator.validate(data)
    for path in ((), ("cameras",), ("source",), ("channel",), ("edge",)):
        wrong = copy.deepcopy(data)
        section = wrong
        for step in path:
            section = section.setdefault(step, {}) or {}
        if section or not path:
            section["unknown_key"] = 1
            assert not validator.is_valid(wrong), path


def test_the_schema_knows_kinds_bounds_and_short_notation(validator: Any) -> None:
    def valid(**sections: Any) -> bool:
        return validator.is_valid({"cameras": {"count": 4}, "source": {"kind": "world"}, **sections})

    assert valid(channel={"service": "exp:60ms", "faults": {"loss": 0.1}}) and valid(edge=None)
    assert valid(source={"kind": "realsense", "width": 640}) and not valid(source={"kind": "world", "iso": 400})
    assert (
        not valid(source={"kind": "webcam"}) and not valid(edge={"update_ms": 1}) and not valid(cameras={"count": -1})
    )


def test_completion_knows_the_commands(capsys):
    text = printed(capsys, "completion", "bash")
    assert "scenario" in text and "--like" in text
