"""The source section and the command: what they take, and one clear line for what they do not."""

from pathlib import Path

from camera_node.cli import main
from camera_node.settings import WorldConfig, find_data, source_config
from freshfield.scenario import ScenarioError, parse
from tests.support import refusal, refused

VIDEO = {"kind": "video", "data": "x"}


def config(**source):
    return source_config(parse({"cameras": {"count": 2}, "source": source}, Path("s.yaml")))


def test_what_is_given_reaches_the_source():
    world = config(kind="world", scene="tile", width=64, params={"supersample": 1}, effects={"sensor_noise": None})
    assert isinstance(world, WorldConfig) and world.codec == "jpeg" and world.fps is None and world.depth_every == 5
    assert world.scene_parameters() == {"width": 64, "supersample": 1}
    assert world.effects == {"sensor_noise": None}
    assert config(kind="camera", devices={"a": 0, "b": "/dev/video2"}).devices == {"a": 0, "b": "/dev/video2"}


def test_errors_name_file_and_key():
    for source, message in (
        ({}, "source.kind: expected one of world, transforms, video"),
        ({"kind": "wrold"}, "source.kind: .*'wrold'"),
        ({"kind": "world", "fbs": 3}, "source.fbs: unknown key; did you mean 'fps'"),
        ({"kind": "world", "effects": {"sensor_noise": 3}}, "source.effects.sensor_noise"),
        ({"kind": "transforms"}, "data: missing"),
        ({"kind": "transforms", "data": "x", "background": "keep"}, "use png"),
        ({**VIDEO, "trajectory": {"files": {}, "start_s": 1e300}}, "trajectory.start_s: expected"),
        ({"kind": "world", "quality": 10**400}, "source.quality: expected .*1 to 100, got 10{99}"),
    ):
        assert str(refused(ScenarioError, message, config, **source)).startswith("s.yaml: source")


def test_data_is_found_below_the_folder_that_was_given(tmp_path, monkeypatch):
    scenario = parse({"cameras": {"count": 2}}, Path("s.yaml"))
    (tmp_path / "set").mkdir()
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    refused(ScenarioError, "--data DIR or set FRESHFIELD_DATA", find_data, "set", scenario, None)
    assert find_data("set", scenario, tmp_path) == tmp_path / "set"
    assert find_data(str(tmp_path / "set"), scenario, None) == tmp_path / "set"
    monkeypatch.setenv("FRESHFIELD_DATA", str(tmp_path))
    assert find_data("set", scenario, None) == tmp_path / "set"
    refused(ScenarioError, "does not exist", find_data, "other", scenario, None)
    # What lies beside the scenario comes first.
    (tmp_path / "mine/set").mkdir(parents=True)
    mine = parse({"cameras": {"count": 2}}, tmp_path / "mine/s.yaml")
    assert find_data("set", mine, tmp_path) == tmp_path / "mine/set"


def fails(capsys, *words: str) -> str:
    said = refusal(capsys, main, *words)
    assert said.startswith("camera-node: ")
    return said


def test_mistakes_are_one_line_and_exit_code_2(capsys, tmp_path, monkeypatch):
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    to = ("--to", "127.0.0.1:1")
    assert "shipped scenarios: " in fails(capsys, "run", "nope", "--all", *to)
    assert "--camera-index 13: expected 0 to 12" in fails(capsys, "run", "room", "--camera-index", "13", *to)
    assert "has no camera cam77; it has cam00, " in fails(capsys, "run", "room", "--camera", "cam01,cam77", *to)
    for wrong in ("host", "host:0", "::1", "http://host:80"):
        assert "--to: expected HOST:PORT" in fails(capsys, "run", "room", "--all", "--to", wrong)
    for wrong in ("-1", "nan"):
        assert "--seconds: expected" in fails(capsys, "run", "room", "--all", "--seconds", wrong, *to)
    assert "cannot read" in fails(capsys, "run", "room", "--all", "--token-file", str(tmp_path / "no"), *to)
    (tmp_path / "file").write_text("")
    refused(SystemExit, "2", main, ["run", "tile", "--all", "--out", str(tmp_path / "file/x"), *to])
    assert "--out: " in capsys.readouterr().err
    (tmp_path / "bad.yaml").write_text("cameras: {count: 20}\nsource: {kind: world, scene: room}\n")
    assert "bad.yaml: source: " in fails(capsys, "run", str(tmp_path / "bad.yaml"), "--all", *to)
