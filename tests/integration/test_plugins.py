"""Classes of one's own in a deployment: from a file beside the scenario, or installed, as the plug-in's template is."""

import asyncio
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from camera_node.capture import build_cameras
from camera_node.node import Node, NodeOptions
from camera_node.settings import source_config
from camera_node.sources.base import pixels
from channel_emu.model.settings import channel_from_mapping
from edge_server.experiments.virtual.simulate_command import main as simulate
from edge_server.export import ExportError
from edge_server.export.run_source import open_source
from edge_server.fields import checkpoint
from edge_server.fields.registry import make_field, option_help
from edge_server.live.buffer import FrameBuffer
from edge_server.live.field_updater import FieldUpdater
from edge_server.scheduler import make_policy
from freshfield.scenario import parse
from freshfield.settings import ScenarioError
from freshfield.transport import Transport
from tests.conftest import ROOT
from tests.edge_server.experiments.rollouts.small import RAW
from tests.edge_server.frames import frame, tiny_field
from tests.support import refused

FILE = Path(__file__).with_name("own_classes.py")
MS = 1_000_000


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder with the classes, and a scenario that names them."""
    shutil.copy(FILE, tmp_path / "own.py")
    edge = {**RAW["edge"], "steps": 2, "updates": "arrivals", "update_ms": 50, "compute": {"ms_per_step": 2.0}}
    edge["policy"] = {"name": "own.py:Youngest", "value": 2}
    source = {**RAW["source"], "effects": {"own.py:Darker": {"counts": 60}}}
    channel = {"service": {"law": "deterministic", "mean_ms": 5.0}, "faults": {"own.py:Late": {"ms": 40.0}}}
    whole = {**RAW, "edge": edge, "source": source, "channel": channel}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(whole))
    monkeypatch.chdir("/")
    return tmp_path


def run(folder: Path, capsys, *words: str) -> dict:
    assert simulate([str(folder / "mine.yaml"), "--seconds", "1.0", "--json", *words]) == 0
    return json.loads(capsys.readouterr().out)


def test_a_deployment_in_virtual_time_uses_them_all_and_repeats(folder, capsys):
    found = run(folder, capsys, "--out", str(folder / "out"))
    assert found == run(folder, capsys)
    lines = [json.loads(line) for line in (folder / "out" / "series.jsonl").read_text().splitlines()]
    assert lines and all(len(line["selected"]) <= 2 for line in lines)
    assert all(line["aaoi_ms"] > 45.0 for line in lines)  # 5 ms of the channel, 40 of the fault
    assert found["policy"] == f"{folder / 'own.py'}:Youngest"
    assert run(folder, capsys, "--policy", "all")["digest"] != found["digest"]


@pytest.mark.stability
def test_a_source_that_raises_loses_those_frames_alone(folder, caplog):
    whole = {"cameras": {"count": 2}, "source": {"kind": f"{folder / 'own.py'}:RaisesOften", "fps": 10}}
    scenario = parse(whole, folder / "raises.yaml")
    cameras = build_cameras(scenario, source_config(scenario), scenario.cameras)
    node = Node(scenario, cameras, NodeOptions(to="127.0.0.1:1", transport=Transport(), seconds=1.0))
    asyncio.run(node.run())
    assert abs(int(pixels(cameras[0].shot(2), cameras[0].codec).mean()) - (40 + 2)) <= 1, "of its own class"
    for status in node.status()["cameras"].values():
        assert status["captured"] > 2 and status["failed"] > 2
    assert len([line for line in caplog.messages if "KeyError('no such frame')" in line]) == 2


def updates(folder, name: str) -> FieldUpdater:
    policy = make_policy(f"{folder / 'own.py'}:{name}", None, np.random.default_rng(0))
    made = FieldUpdater(FrameBuffer(("cam01", "cam02")), policy, tiny_field(), start_ns=0)
    for camera in ("cam01", "cam02"):
        made.buffer.put(frame(camera, generated_ns=100 * MS), 120 * MS)
    return made


@pytest.mark.stability
@pytest.mark.parametrize("name", ["RaisesInPlan", "RaisesInSelect", "NamesNobody"])
def test_a_policy_that_raises_costs_its_decision_live_and_stops_what_is_measured(folder, caplog, name):
    live, measured = updates(folder, name), updates(folder, name)
    live.forgiving = True
    for _ in range(2):
        assert {item.camera for item in live.select(live.plan(200 * MS), 200 * MS).items} == {"cam01", "cam02"}
    assert live.policy_failures == 2 and f"own.py:{name} failed 2 times" in live.troubles[0]
    assert len([line for line in caplog.messages if "all views are used" in line]) == 1
    live.policy = make_policy("all", None, np.random.default_rng(0))
    assert not live.troubles
    refused((RuntimeError, KeyError), "", lambda: measured.select(measured.plan(200 * MS), 200 * MS))


def test_what_is_of_the_wrong_kind_is_refused_by_name(folder):
    own = f"{folder / 'own.py'}:"

    def source(**section):
        source_config(parse({"cameras": {"count": 2}, "source": section}, Path("raw.yaml")))

    for use, why in (
        (lambda: make_policy(f"{own}Darker", None, None), r"does not derive from edge_server\.scheduler\.Policy"),
        (lambda: channel_from_mapping({"faults": {f"{own}Youngest": {}}}), r"from channel_emu\.model\.link\.Fault"),
        (lambda: make_field(f"{own}Youngest"), "expected an attribute Settings"),
        (lambda: source(kind=f"{own}Youngest"), r"raw.yaml: source.kind: .*base\.Source"),
    ):
        refused(ScenarioError, why, use)


def test_a_field_of_ones_own_runs_is_saved_and_is_not_loaded_from_a_folder_of_others(folder, capsys):
    own = f"{folder / 'own.py'}:Flat"
    assert "level" in option_help(own)
    refused(ScenarioError, "has no option hight", make_field, own, {"hight": 1})
    edge = {**RAW["edge"], "field": "own.py:Flat", "field_options": {"level": 0.25}}
    (folder / "mine.yaml").write_text(yaml.safe_dump({**RAW, "edge": edge}))
    assert run(folder, capsys)["updates"] > 0
    field = make_field(own, {"level": 0.25})
    checkpoint.save(folder / "flat.npz", field.state(), {"field": own, "options": {}})
    refused(ExportError, "--allow-plugins", open_source, folder / "flat.npz")
    with pytest.raises(ExportError, match="has seen no camera yet"):  # its code ran
        open_source(folder / "flat.npz", allow_plugins=True)


def python(words: list[str], cwd: Path, *path: Path) -> str:
    here = [str(each) for each in (*path, ROOT / "proto", ROOT, ROOT / "deploy")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(here)}
    command = [sys.executable, "-m", *words]
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_the_template_is_built_installed_checked_and_used(tmp_path):
    plugin, wheels, site = tmp_path / "plugin", tmp_path / "wheels", tmp_path / "site"
    shutil.copytree(ROOT / "examples/plugin", plugin)
    python(["pip", "wheel", "-q", "--no-deps", "-w", str(wheels), str(plugin)], tmp_path)
    (wheel,) = wheels.iterdir()
    python(["pip", "install", "-q", "--no-deps", "--no-index", "--target", str(site), str(wheel)], tmp_path)
    (plugin / "freshfield_example.py").unlink()  # the installed one is meant

    assert "4 passed" in python(["pytest", "-q", "test_contract.py"], plugin, site)
    edge = {**RAW["edge"], "policy": {"name": "least-used", "value": 1}}
    source = {"kind": "bar", "bar_px": 4, "effects": {"vignette": {"loss": 0.3}}}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump({**RAW, "edge": edge, "source": source}))
    words = ["edge_server.cli", "simulate", "mine.yaml", "--seconds", "1", "--json"]
    found = json.loads(python(words, tmp_path, site))
    assert found["policy"] == "least-used" and found["updates"] > 0
