"""The source section: what it takes, and one clear line for what it does not."""

from __future__ import annotations

from pathlib import Path

import pytest

from camera_node.settings import WorldConfig, find_data, source_config
from freshfield.scenario import ScenarioError, parse

VIDEO = {"kind": "video", "data": "x"}


def config(**source):
    return source_config(parse({"cameras": {"count": 2}, "source": source}, Path("s.yaml")))


def test_what_is_given_reaches_the_source():
    world = config(kind="world", scene="tile", width=64, params={"supersample": 1}, effects={"sensor_noise": None})
    assert isinstance(world, WorldConfig) and world.codec == "jpeg" and world.fps is None and world.depth_every == 5
    assert world.scene_parameters() == {"width": 64, "supersample": 1}
    assert world.effects == {"sensor_noise": None}
    assert config(kind="camera", devices={"a": 0, "b": "/dev/video2"}).devices == {"a": 0, "b": "/dev/video2"}


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ({}, "source.kind: expected one of world, transforms, video"),
        ({"kind": "wrold"}, "source.kind: .*'wrold'"),
        ({"kind": "world", "fbs": 3}, "source.fbs: unknown key; did you mean 'fps'"),
        ({"kind": "world", "effects": {"sensor_noise": 3}}, "source.effects.sensor_noise"),
        ({"kind": "transforms"}, "data: missing"),
        ({"kind": "transforms", "data": "x", "background": "keep"}, "use png"),
        ({**VIDEO, "trajectory": {"files": {}, "start_s": 1e300}}, "trajectory.start_s: expected"),
        ({"kind": "world", "quality": 10**400}, "source.quality: expected .*1 to 100, got 10{99}"),
    ],
)
def test_errors_name_file_and_key(source, message):
    with pytest.raises(ScenarioError, match=message) as error:
        config(**source)
    assert str(error.value).startswith("s.yaml: source") and "\n" not in str(error.value)


def test_data_is_found_below_the_folder_that_was_given(tmp_path, monkeypatch):
    scenario = parse({"cameras": {"count": 2}}, Path("s.yaml"))
    (tmp_path / "set").mkdir()
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    with pytest.raises(ScenarioError, match="--data DIR or set FRESHFIELD_DATA"):
        find_data("set", scenario, None)
    assert find_data("set", scenario, tmp_path) == tmp_path / "set"
    assert find_data(str(tmp_path / "set"), scenario, None) == tmp_path / "set"
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path))
    assert find_data("set", scenario, None) == tmp_path / "set"
    with pytest.raises(ScenarioError, match="does not exist"):
        find_data("other", scenario, None)
    # What lies beside the scenario comes first.
    (tmp_path / "mine/set").mkdir(parents=True)
    mine = parse({"cameras": {"count": 2}}, tmp_path / "mine/s.yaml")
    assert find_data("set", mine, tmp_path) == tmp_path / "mine/set"
