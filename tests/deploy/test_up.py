"""The launcher with the real processes: runs that end as asked, and runs in which a process dies; that of a simulated
arm, and which processes start in which order."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

import freshfield as ff
from freshfield.scenario import ScenarioError, load
from freshfield_up import commands
from freshfield_up import run as launcher
from freshfield_up.cli import main
from freshfield_up.commands import ProcessSet
from freshfield_up.demo_command import seconds
from freshfield_up.deployment import DeploymentError
from freshfield_up.folder import EARLIER, prepare
from freshfield_up.processes import Child
from freshfield_up.status import read_json
from tests.camera_node.robot.arm.simulated import own_address, require_ur_rtde
from tests.support import free_port, refused, wait_until

SMALL = """
name: small
description: the smallest thing that is still a room
seed: 3
cameras: {count: 4, held_out: [cam00]}
source: {kind: world, scene: room, width: 48, height: 48, fps: 10}
channel: {preset: ch5}
edge: {field: ngp, update_ms: 300, lpips: none}
"""
SLEEPS = "import time; time.sleep(60)"
pytestmark = pytest.mark.timeout(600)


class Up:
    """A running launcher; its output goes to a file."""

    def __init__(self, folder: Path, *options: str, scenario: str = SMALL) -> None:
        self.out = folder / "run"
        self.port = free_port()
        file = folder / "small.yaml"
        file.write_text(scenario)
        self._log = folder / "output.txt"
        words = [str(file), "--out", str(self.out), "--port", str(self.port), *options]
        with self._log.open("wb") as log:
            command = [sys.executable, "-m", "freshfield_up.cli", "demo", *words]
            self.process = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT)

    @property
    def output(self) -> str:
        return self._log.read_text()


@pytest.fixture
def asleep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., launcher.Launcher]:
    """Makes a launcher whose edge and emulator only sleep, and whose node runs the given words."""

    def make(node: str) -> launcher.Launcher:
        monkeypatch.setattr(launcher.signal, "signal", lambda *_: None)
        words = {"edge": SLEEPS, "emulator": SLEEPS, "node": node}
        made = [Child(k, f"the {k}", [sys.executable, "-c", v], tmp_path / "run" / k) for k, v in words.items()]
        processes = ProcessSet(*made, "127.0.0.1:1", "")
        monkeypatch.setattr(launcher, "process_set", lambda *_: processes)
        (tmp_path / "small.yaml").write_text(SMALL)
        run = launcher.Launcher(load(tmp_path / "small.yaml"), launcher.Options(tmp_path / "run", port=free_port()))
        run.processes = processes
        return run

    return make


def test_a_process_that_dies_ends_the_run_is_named_and_the_others_are_stopped(asleep, capfd):
    run = asleep("import os, time; print('so much'); time.sleep(0.8); os.kill(os.getpid(), 9)")
    assert run.run() == 1
    said, made = capfd.readouterr().out, run.processes
    assert "the node was killed by SIGKILL" in said and "  | so much" in said
    assert said.endswith("no report: the run did not start\n")
    assert not any(child.running for child in made.children) and made.emulator.process is None
    rows = [json.loads(line) for line in (run.options.out / "processes.jsonl").read_text().splitlines()]
    assert rows[0]["edge"]["pid"] == made.edge.pid and "machine" in rows[0]


def test_a_trouble_is_said_once_of_each_camera_though_its_numbers_change(asleep):
    run, said = asleep("pass"), []
    run._say = said.append
    run.options.out.mkdir()
    first = [f"cam0{k}: its poses drift: the picture asks for 9 cm and .5 degrees" for k in range(2)]
    plugin = "policy Mine failed 3 times: all views were used"
    for troubles in ([*first, plugin], [first[0].replace("9 cm", "1e+03 cm"), plugin.replace("3", "14")]):
        (run.options.out / "edge.json").write_text(json.dumps({"troubles": troubles}))
        run._say_troubles()
    assert said == [f"note: {line}" for line in (*first, plugin)]


def test_a_recording_that_is_over_before_the_first_update_ends_the_run_well(asleep, capfd, monkeypatch):
    """Kernels are still being compiled."""
    run = asleep("import time; time.sleep(0.5)")
    emulator = run.processes.emulator
    monkeypatch.setattr(run, "_continue_start", lambda now_s: emulator.process or emulator.start())
    assert run.run() == 0 and "the recording is over" in capfd.readouterr().out


def test_a_run_whose_lines_nobody_reads_ends_as_at_ctrl_c(asleep, monkeypatch):
    """``freshfield demo room | head -3``."""
    run = asleep(SLEEPS)
    edge, (reader, writer) = run.processes.edge, os.pipe()
    monkeypatch.setattr(edge, "start", lambda: (Child.start(edge), os.close(reader)))
    monkeypatch.setattr(sys, "stdout", os.fdopen(writer, "w"))
    assert run.run() == 0
    assert edge.process is not None and not any(child.running for child in run.processes.children)


def test_ctrl_c_ends_a_run_and_a_second_one_kills(asleep, capfd):
    run = asleep("import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print('up'); time.sleep(60)")
    log = run.processes.node.log

    def press_twice() -> None:
        wait_until(lambda: log.exists() and "\nup\n" in log.read_text(), "no node")
        for _ in range(2):
            run._on_signal(signal.SIGINT, None)

    threading.Thread(target=press_twice, daemon=True).start()
    assert run.run() == 0 and run.processes.node.killed
    said = capfd.readouterr().out
    assert "stopping (Ctrl-C)" in said and "the node did not end in time and was killed" in said


def test_a_start_that_fails_says_why_and_costs_no_earlier_run(tmp_path):
    prepare(tmp_path / "run", {}).close()
    (tmp_path / "run" / "report.json").write_text("{}")
    run = Up(tmp_path, "--policy", "foo")
    assert run.process.wait(90.0) == 1
    assert "'foo' is not known" in run.output and "ended by itself with exit code 2" in run.output
    assert run.output.endswith(f"the run was never up; an earlier run's files are in {run.out / EARLIER}\n")
    assert (run.out / EARLIER / "report.json").exists()


def test_times_and_commands_are_read_and_written_as_people_write_them(asleep):
    assert [seconds(text) for text in ("60", "60s", "1.5m", "2h", "0")] == [60.0, 60.0, 90.0, 7200.0, 0.0]
    assert launcher.command_line(["/usr/bin/freshfield", "demo", "my file"]) == "freshfield demo 'my file'"
    assert launcher.command_line(["/lib/freshfield_up/__main__.py", "demo"]) == "freshfield demo"
    assert launcher.command_line(["examples/deployment.py", "card", "6"]) == "python examples/deployment.py card 6"
    run = asleep("pass")
    run._ready_s = 100.0
    assert run._headline(112.9) == "12 of 60 s"
    run.options = replace(run.options, duration_s=0.0)
    assert run._headline(112.9) == "12 s"


def test_what_cannot_run_is_refused_in_one_line_before_anything_starts(tmp_path, capsys):
    def refusal(scenario: str | Path, port: int, out: str = "new", *more: str) -> str:
        assert main(["demo", str(scenario), "--out", str(tmp_path / out), "--port", str(port), *more]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1 and not (tmp_path / "new").exists()
        return said

    (typo := tmp_path / "typo.yaml").write_text(SMALL.replace("cameras:", "camera:"))
    assert "did you mean 'cameras'?" in refusal(typo, free_port())
    assert "shipped scenarios: " in refusal("no-such-scenario", free_port())
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        assert "is taken by another program" in refusal("room", taken.getsockname()[1])
    (out := tmp_path / "run").mkdir()
    (out / "run.json").write_text("{}")
    (learned := out / "learned.npz").write_bytes(b"weights")
    said = refusal("room", free_port(), "run", "--policy", f"bandit:{learned}")
    assert "is emptied first; choose another --out" in said and learned.read_bytes() == b"weights"


def test_a_deployment_in_a_script_says_why_it_cannot_start(tmp_path):
    (tmp_path / "small.yaml").write_text(SMALL.replace("lpips: none", "policy: {name: nothing}"))
    with (
        pytest.raises(DeploymentError, match="the edge server"),
        ff.deployment(tmp_path / "small.yaml", out=tmp_path / "run"),
    ):
        pass
    refused(ScenarioError, "shipped scenarios", ff.deployment, "nothing")


CELL = load("cell")


def test_a_simulated_arm_and_its_driver_belong_to_the_run(monkeypatch, tmp_path):
    monkeypatch.setattr(commands, "program", lambda name: name)
    found = commands.process_set(CELL, tmp_path, 8080)
    assert [child.command[1] for child in found.arms + found.drivers] == ["simulate-arm", "drive-arm"]
    assert found.arm_address == "127.0.0.2:30004"
    # Senders stop before receivers: driver, cameras, arm, channel, edge.
    assert [child.name for child in found.children] == ["driver", "node", "arm", "emulator", "edge"]


@pytest.mark.slow
def test_the_cell_runs_from_one_command(tmp_path):
    require_ur_rtde()
    mount = CELL.path.parent / CELL.source["arm"]["cameras"]["hand"]
    text = CELL.path.read_text().replace("../lab/hand-eye-example.yaml", str(mount))
    text = re.sub(r"host: \S+", f"host: {own_address()}", text)
    text = text.replace("width: 128", "width: 48").replace("height: 128", "height: 48")
    run = Up(tmp_path, scenario=text)
    try:
        wait_until(
            lambda: read_json(run.out / "edge.json").get("updates", {}).get("count", 0) >= 30, "no updates", 400.0
        )
        run.process.terminate()
        assert run.process.wait(300.0) == 0, run.output
    finally:
        run.process.kill()
    frames = read_json(run.out / "report.json")["frames"]
    assert frames["closes"] and frames["by_camera"]["hand"]["delivered"] > 5
    assert "43 viewpoints in 62 stops\n" in (run.out / "log-driver.txt").read_text()
    # The arm sets out when the field can learn: after the emulator, which waits for the edge to serve.
    # All may begin within one row; but processes are numbered in their order.
    last = json.loads((run.out / "processes.jsonl").read_text().splitlines()[-1])
    numbers = int(Path("/proc/sys/kernel/pid_max").read_text())
    assert 0 < (last["driver"]["pid"] - last["emulator"]["pid"]) % numbers < numbers // 2
