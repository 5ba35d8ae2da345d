"""What an ``edge:`` section leaves open is chosen by what cameras do; what long work says; the machine of a run."""

import importlib
import io
import os
from pathlib import Path

import msgspec
import pytest

from edge_server.edge_constants import CARRIED_OPTIONS, MOST_CARRIED
from edge_server.embed.settings import EmbeddingConfig
from edge_server.machine import machine
from edge_server.progress import ProgressLine
from edge_server.settings import EdgeConfig, KeyframesConfig, cameras_move, read_config
from freshfield.scenario import ScenarioError, parse
from freshfield.settings import Settings
from tests.support import refused

STILL = EdgeConfig("splat", {"layers": True}, updates="arrivals", update_ms=20.0, steps=10)
MOVING = EdgeConfig("splat", CARRIED_OPTIONS, updates="cycle", update_ms=80.0, steps=8)
MANY_MOVING = EdgeConfig("splat", updates="cycle", update_ms=800.0, steps=100, keyframes=KeyframesConfig(32, 0.03, 5.0))


def scenario(edge=None, **source):
    return parse({"cameras": {"count": 3}, "source": source, "edge": edge}, Path("x.yaml"))


def kinds_of(kind):
    for each in kind.__subclasses__():
        yield each
        yield from kinds_of(each)


def test_every_default_lies_within_its_own_bounds():
    fields = [f"edge_server.fields.{name}" for name in ("nerfacto", "splat", "tensorf")]
    for room in ("camera_node", "channel_emu.model", *fields):
        importlib.import_module(f"{room}.settings")
    importlib.import_module("camera_node.synthetic.scene_parameters")
    ours = [each for each in kinds_of(Settings) if not each.__module__.startswith("tests.")]
    known = [(each, field) for each in ours for field in msgspec.structs.fields(each)]
    assert len(known) > 300
    for each, field in known:
        if not field.required:
            made = field.default if field.default is not msgspec.NODEFAULT else field.default_factory()
            assert msgspec.convert(msgspec.to_builtins(made), field.type) == made, f"{each.__name__}.{field.name}"


def test_an_empty_section_works_in_layers_before_fixed_cameras_and_as_a_scan_before_moving_ones():
    assert read_config(scenario({})) == read_config(scenario()) == STILL
    assert read_config(scenario({}), moving=True) == MOVING
    for count, expected in ((MOST_CARRIED, MOVING), (MOST_CARRIED + 1, MANY_MOVING)):
        assert read_config(parse({"cameras": {"count": count}}, Path("x.yaml")), moving=True) == expected


@pytest.mark.parametrize("key", ["arm", "trajectory"])
def test_cameras_that_an_arm_or_a_trajectory_carries_are_known_to_move(key):
    assert cameras_move(scenario(**{key: {"host": "127.0.0.2"}})) and not cameras_move(scenario())
    assert read_config(scenario(**{key: {}})) == MOVING
    assert read_config(scenario(**{key: {}}), moving=False) == STILL


@pytest.mark.parametrize(
    ("edge", "still", "moving"),
    [
        ({"updates": "cycle"}, (False, "cycle", 800.0, 100, False), (False, "cycle", 800.0, 100, True)),
        ({"update_ms": 50}, (True, "arrivals", 50.0, 10, False), (False, "cycle", 50.0, 8, False)),
        ({"field": "ngp"}, (False, "cycle", 800.0, 100, False), (False, "cycle", 800.0, 100, True)),
        ({"field_options": {"layers": False}}, (False, "cycle", 800.0, 100, False), (False, "cycle", 80.0, 8, False)),
        ({"field_options": {"layers": True}}, (True, "arrivals", 20.0, 10, False), (True, "arrivals", 20.0, 10, False)),
        ({"keyframes": None}, (True, "arrivals", 20.0, 10, False), (False, "cycle", 800.0, 100, False)),
        ({"keyframes": {"most": 5}}, (True, "arrivals", 20.0, 10, True), (False, "cycle", 800.0, 100, True)),
    ],
)
def test_what_a_scenario_says_wins(edge, still, moving):
    for expected, moves in ((still, False), (moving, True)):
        found = read_config(scenario(edge), moving=moves)
        layers = bool(found.field_options.get("layers"))
        assert (layers, found.updates, found.update_ms, found.steps, found.keyframes is not None) == expected
    for given in ({"gaussians": 900}, {"layers": False}):
        found = read_config(scenario({"field_options": given}), moving=True)
        assert found.field_options == {**CARRIED_OPTIONS, **given}


def test_files_that_a_section_names_lie_beside_the_scenario():
    def named(**edge):
        found = read_config(parse({"cameras": {"count": 2}, "edge": edge}, Path("/there/x.yaml")))
        return found.embedding, found.foreground and found.foreground.detector

    assert named() == (None, None)
    assert named(embedding={}, foreground={"detector": "tile"}) == (EmbeddingConfig(), "tile")
    own = {"embedding": {"model": "m/yolo.onnx", "dim": 16}, "foreground": {"detector": "cat-seg.onnx"}}
    assert named(**own) == (EmbeddingConfig("/there/m/yolo.onnx", 16), "/there/cat-seg.onnx")


@pytest.mark.parametrize(("named", "level"), [("auto", 1.0), ("black", 0.0), ("#333333", 0.2), ("#3", 1.0)])
def test_transparent_images_are_scored_over_the_color_that_the_field_shows_there(named, level):
    assert read_config(scenario({"field_options": {"background": named}})).background == (level,) * 3


def test_a_section_of_another_kind_is_refused_by_name():
    uncertain = {"foreground": {"detector": "tile", "confidence": 1.5}}
    wrong = (({"field_options": 3}, "field_options"), ([], "edge"), ({"field": 3}, "field"), (uncertain, "confidence"))
    for edge, named in wrong:
        refused(ScenarioError, f"x.yaml: .*{named}", lambda edge=edge: read_config(scenario(edge)))


def test_a_pipe_is_told_of_long_work_alone(monkeypatch):
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr("edge_server.progress.time.perf_counter", lambda: now[0])
    line = ProgressLine(out)
    for stage, each_s in (("depth", 0.05), ("sharpen", 2.0), ("fuse", 0.05)):
        for step in range(11):
            line(stage, step / 10)
            now[0] += each_s
    assert out.getvalue() == "  sharpen: some 18 s\n"


def test_gpus_are_named_and_a_machine_without_proc_is_unknown(tmp_path):
    found = machine(tmp_path)
    assert found["memory_gb"] is None and found["gpus"] == []
    assert found["cores"] == len(os.sched_getaffinity(0))
    gpu = tmp_path / "driver/nvidia/gpus/0000:01:00.0/information"
    gpu.parent.mkdir(parents=True)
    gpu.write_text("Model: \t\t NVIDIA H100 80GB HBM3\nIRQ:   \t\t 42\n")
    (other := gpu.parent.parent / "0000:02:00.0").mkdir()
    (other / "information").write_text("IRQ:   \t\t 43\n")
    assert machine(tmp_path)["gpus"] == ["NVIDIA H100 80GB HBM3"]
