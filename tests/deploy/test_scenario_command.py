"""``freshfield scenario``: what it lists, writes, checks and describes; every shipped one is valid. ``freshfield
check-plugin``: what keeps its contract passes, and each check can fail."""

import itertools
import json
import re
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest

from camera_node.robot.arm.camera_poses import load_hand_eyes
from camera_node.settings import LiveConfig, source_config
from camera_node.sources.registry import open_sources
from channel_emu.model import faults
from edge_server.scheduler import POLICIES, SelectionWindow
from freshfield import plugins
from freshfield.scenario import SCENARIO_FOLDER, load
from freshfield.settings import Settings
from freshfield.untrusted import read_yaml
from freshfield_up.cli import main
from freshfield_up.scenario_command import checked
from freshfield_up.scenario_keys import schema
from tests.conftest import data_dir
from tests.integration.own_classes import Darker, Flat, LastFirst, Late, Turning, Youngest
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


@pytest.mark.parametrize("name", ["card", "videos", "cell", "scan"])
def test_a_file_of_ones_own_starts_as_a_shipped_one_and_is_valid(name, tmp_path, capsys):
    mine = tmp_path / "new" / "mine.yaml"
    said = printed(capsys, "scenario", "init", str(mine), "--like", name)
    step = "camera-node calibrate rig" if name == "videos" else f"freshfield scenario check {mine}"
    assert f"next: {step}" in said
    text = printed(capsys, "scenario", "show", str(mine))
    assert '\nname: "mine"\n' in text and text.count("\n") == printed(capsys, "scenario", "show", name).count("\n")
    assert "valid" in printed(capsys, "scenario", "check", str(mine))
    if name in ("cell", "scan"):
        scenario = load(mine)
        assert load_hand_eyes(scenario, source_config(scenario).arm, ["hand"])["hand"].setup == "eye-in-hand"
        printed(capsys, "scenario", "init", str(mine.with_name("other.yaml")), "--like", name)
    assert "exists" in refused(capsys, "scenario", "init", str(mine))
    assert mine.read_text() == text
    assert "expected a name" in refused(capsys, "scenario", "init", str(tmp_path / "a: b.yaml"))
    number = tmp_path / "plain" / "123.yaml"  # which YAML would not read as text
    printed(capsys, "scenario", "init", str(number), "--like", "quad")
    assert "valid" in printed(capsys, "scenario", "check", str(number))
    assert "File exists" in refused(capsys, "scenario", "init", str(number / "in-a-file.yaml"))
    number.write_text('{cameras: {count: 2}, source: {kind: world}, channel: {service: "det:60ms"}}')
    assert "channel  its own: mean delay 60 ms" in printed(capsys, "scenario", "check", str(number))
    (tmp_path / "card").mkdir()
    assert "card: exists" in refused(capsys, "scenario", "init", str(tmp_path / "third.yaml"), "--like", "card")
    assert not (tmp_path / "third.yaml").exists()


def test_check_reads_every_section(tmp_path, capsys):
    for section, wrong in (
        ("source: {kind: mcap, file: a.mcap}", "cameras.phase: spread applies to source.kind world only"),
        ("source: {kind: world, scene: castle}", "source: .*castle"),
        ("source: {kind: world, effects: {OWN:Darker: {counts: 256}}}", "Darker.counts: expected .*0 to 255, got 256"),
        ("source: {kind: OWN:Turning, level: 256}", "source.level: expected .*0 to 255, got 256"),
        ("source: {kind: world, arm: {host: h, cameras: {a: b}, teleop: {speed: 1}}}", "arm.teleop.speed: unknown key"),
        ("source: {kind: world, arm: {host: h, cameras: {cam00: b}}}", "arm.cameras.cam00: .*/b: cannot be read"),
        ("source: {kind: oak, trajectory: {files: {cam00: a}, hand_eye: b}}", "hand_eye: .*/b: cannot be read"),
        ("edge: {policy: {name: freshest-k, value: 0.5}}", "edge.policy: k: expected a whole number"),
        ("edge: {field: OWN:Flat, field_options: {level: 2}}", "edge.field: flat.level: expected .*0 to 1, got 2"),
        ("channel: {faults: {rain: 1}}", "channel.faults.rain"),
        ("channel: {faults: {blackout: {windows_ms: [[0, 1]], cameras: [me]}}}", "'me' is not one of the scenario's: "),
    ):
        file = tmp_path / "mine.yaml"
        source = "" if section.startswith("source") else "source: {kind: world, scene: room}\n"
        phase = "spread" if "mcap" in section else "locked"
        file.write_text(f"cameras: {{count: 4, phase: {phase}}}\n{source}{section.replace('OWN', str(OWN))}\n")
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
def test_every_package_accepts_its_section_and_cameras_have_a_first_image(file):
    scenario = load(file)
    assert scenario.name == file.stem, "a report names the scenario: it must lead back to the file"
    assert scenario.description
    config = source_config(scenario)
    arm = getattr(config, "arm", None)
    # A scene needs views from several sides: of several cameras, of two that measure depth, or of one that an arm or
    # somebody carries round it.
    depth = "depth_sensor" in config.effects or config.kind in ("oak", "realsense")
    least = 1 if scenario.held_out_every else 2 if depth else 3
    assert len(scenario.training) >= least or set(arm.cameras) >= set(scenario.training)
    assert checked(scenario)
    if isinstance(config, LiveConfig) or arm is not None:
        return  # tests of devices and of the simulated controller have their images
    folder = getattr(config, "data", "")
    data = data_dir(folder.split("/")[0]).parent if folder else None
    # One trained and one held-out camera: a world takes a while to prepare each.
    cameras = [scenario.training[0], *scenario.held_out[:1]]
    sources = open_sources(scenario, config, cameras, data)
    assert set(sources) == set(cameras)
    for source in sources.values():
        shot = source.read(source.content(0))
        assert (shot.intrinsics.width, shot.intrinsics.height) == (source.intrinsics.width, source.intrinsics.height)


COUNT = itertools.count()
# Effects: tests/camera_node/synthetic/effects/test_effects.py.
BUILT_IN = [("policy", name) for name in POLICIES] + [("fault", name) for name in faults.NAMES]
BUILT_IN += [("selector", name) for name in ("random", "coverage", "fisher")]
FAULTS = {"loss": "probability=0.5", "duplication": "probability=0.5", "corruption": "probability=0.5 count=3"}
FAULTS |= {"blackout": "windows_ms=[[0,50]]", "reset": "mean_interval_ms=100", "bandwidth": "megabits_per_s=1"}


class OnlyOpen(LastFirst):
    """Values nothing that is captured."""

    def values(self, state):
        return np.where(np.isin(np.arange(len(state.open)), state.order), np.nan, 1.0)


def painted(level):
    """A render of this level: a function of the field."""

    def render(self, camera_to_world, intrinsics):
        out = Flat.render(self, camera_to_world, intrinsics)
        out.color[:] = level(self)
        return out

    return render


def seen(self):
    return self.views[0].image.mean() / 255 if self.views else 0.0


def in_turn(self, transit):
    self.asked = getattr(self, "asked", 0) + 1
    return self.asked < 10


def take_views(self, state):
    self.views = state["level"].views


def first_of(share):
    return lambda self, epoch, window: tuple(epoch.generated_ns)[: share(epoch.generated_ns)]


LATE = SelectionWindow(wait_until_ns=24 * 3600 * 10**9)
NO_DEFAULT = type(Settings)("Params", (Settings,), {"__annotations__": {"ms": float}})
NO_COPY = {"render": painted(seen), "state": lambda s: {"level": s}, "load_state": take_views}
BASES = {"policy": Youngest, "effect": Darker, "fault": Late, "field": Flat, "selector": LastFirst, "source": Turning}
OWN_CLASSES = [(kind, f"{OWN}:{good.__name__}") for kind, good in BASES.items()]
# Kind -> name of a class -> how it differs from the good one, and what the command says.
BROKEN = {
    "source": {
        "Swaps": (
            {"camera": property(lambda s: "cam01", lambda s, v: None)},
            "the first frames: camera: not the one of the call",
        ),
        "Fast": ({"fps": 10}, "the first frames: fps: expected a Fraction"),
        "Ends": ({"contents": 3, "content": lambda s, tick: tick}, "the first frames: content: expected 0 to contents"),
        "Picture": ({"read": lambda s, n: Turning.read(s, n).image}, "the first frames: read: expected a Shot"),
    },
    "policy": {
        "Patient": ({"plan": lambda *_: LATE}, "six cameras: plan: it waits for more than an hour"),
        "Nobody": ({"select": lambda *_: ("cam99",)}, "one camera: select: expected cameras, one at least"),
        "Nothing": ({"select": lambda *_: ()}, "six cameras: select: expected cameras, one at least"),
        "List": ({"select": lambda *_: []}, "one camera: select: expected a tuple of cameras, got list"),
        "Changes": ({"select": first_of(lambda names: next(COUNT) % 7 or 1)}, "six cameras: two runs differ"),
        "AnyValue": ({"__init__": lambda s, value, rng: None}, "value out of range is refused: -1 is accepted"),
    },
    "effect": {
        "Floats": ({"apply": lambda s, image, *_: image / 2}, "a black image: image: expected array uint8 (12, 16, 3)"),
        "InPlace": ({"apply": lambda s, image, *_: np.subtract(image, 1, out=image)}, "a noisy image: an input was"),
    },
    "fault": {
        "Early": ({"extra_ns": lambda *_: -1}, "usual messages: extra_ns: expected nanoseconds from 0"),
        "InTurn": ({"loses": in_turn}, "does not depend on the order of questions: draw by the number"),
        "Demanding": ({"Params": NO_DEFAULT}, "is constructed: ScenarioError"),
    },
    "field": {
        "Bytes": ({"render": painted(lambda s: 255)}, "one camera: color: below 0, or above 1"),
        "Forgets": ({"render": painted(seen)}, "snapshots stay and states go on: load_state: it renders"),
        "Itself": (NO_COPY, "snapshots stay and states go on: snapshot: it changes"),
        "AnyState": ({"load_state": lambda *_: None}, "snapshots stay and states go on: load_state: the state of"),
    },
    "selector": {"OneValue": ({"values": lambda *_: np.zeros(1)}, "half captured: values: expected one a candidate")},
}
ROWS = [(kind, name, *row) for kind, rows in BROKEN.items() for name, row in rows.items()]
globals().update({name: type(BASES[kind])(name, (BASES[kind],), dict(has)) for kind, name, has, _ in ROWS})


@pytest.mark.parametrize(("kind", "name"), [*BUILT_IN, *OWN_CLASSES, ("selector", f"{__file__}:OnlyOpen")])
def test_what_keeps_its_contract_passes(kind, name, capsys):
    words = FAULTS[name].split() if name in FAULTS else []
    assert main(["check-plugin", kind, name, *words]) == 0, capsys.readouterr().out


@pytest.mark.parametrize(("kind", "name", "says"), [(kind, name, says) for kind, name, _, says in ROWS])
def test_each_check_can_fail(kind, name, says, capsys):
    assert main(["check-plugin", kind, f"{__file__}:{name}"]) == 1
    assert f"FAILED  {says}" in capsys.readouterr().out
