"""The launcher with the real processes: runs that end as asked, and runs in which a process dies."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import freshfield as ff
from freshfield.scenario import ScenarioError, load
from freshfield_up import run as launcher
from freshfield_up.commands import ProcessSet
from freshfield_up.deployment import DeploymentError
from freshfield_up.folder import EARLIER, prepare
from freshfield_up.processes import Child
from freshfield_up.status import read_json
from tests.conftest import ROOT
from tests.support import free_port

SMALL = """
name: small
description: the smallest thing that is still a room
seed: 3
cameras: {count: 4, held_out: [cam00]}
source: {kind: world, scene: room, width: 48, height: 48, fps: 10}
channel: {preset: ch5}
edge: {field: ngp, update_ms: 300, lpips: none}
"""
# A first run compiles the field's kernels.
READY_S = 400.0
SLEEPS = "import time; time.sleep(60)"
pytestmark = pytest.mark.timeout(600)


class Up:
    """A running launcher; its output goes to a file, as with nohup."""

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

    def wait_until(self, what: Callable[[], Any], seconds: float = READY_S) -> Any:
        deadline = time.monotonic() + seconds
        while not (found := what()):
            assert self.process.poll() is None, f"the launcher ended too early:\n{self.output}"
            assert time.monotonic() < deadline, f"it did not happen in {seconds:.0f} s:\n{self.output}"
            time.sleep(0.1)
        return found

    def wait_for_updates(self, count: int = 2) -> None:
        self.wait_until(lambda: (self.status().get("updates") or {}).get("count", 0) >= count)

    def status(self) -> dict[str, Any]:
        return read_json(self.out / "edge.json")

    def pid(self, name: str) -> int:
        """Process id as the launcher's own record has it."""

        def find() -> int | None:
            lines = (self.out / "processes.jsonl").read_text().splitlines()
            return json.loads(lines[-1]).get(name, {}).get("pid") if lines else None

        return self.wait_until(find)

    def report(self) -> dict[str, Any]:
        return json.loads((self.out / "report.json").read_text())

    def end(self, seconds: float = 90.0) -> int:
        return self.process.wait(seconds)


@pytest.fixture
def up(tmp_path: Path) -> Iterator[Callable[..., Up]]:
    started: list[Up] = []

    def start(*options: str, **more: str) -> Up:
        started.append(Up(tmp_path, *options, **more))
        return started[-1]

    yield start
    for one in started:
        if one.process.poll() is None:
            one.process.terminate()
            one.process.wait(60.0)


def leftovers(out: Path) -> list[str]:
    """Command lines of processes that still work on the run."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            words = path.read_bytes().decode(errors="replace").replace("\0", " ")
        except OSError:
            continue
        if str(out) in words:
            found.append(words)
    return found


@pytest.mark.slow  # 11 s; make demo in CI ends so, too
def test_a_run_ends_when_its_time_is_up_with_a_report(up: Callable[..., Up]) -> None:
    run = up("--for", "6s")
    assert run.end(READY_S + 60.0) == 0, run.output
    assert re.search(rf"page: http://127\.0\.0\.1:{run.port}\b", run.output)
    assert "0.0.0.0" not in run.output
    assert f"ssh -L {run.port}:127.0.0.1:{run.port}" in run.output
    assert re.search(r"\[\d+ of 6 s\] 4/4 cameras, age \d+ ms", run.output)
    assert "all accounted for" in run.output and str(run.out / "report.html") in run.output
    report = run.report()
    assert report["frames"]["closes"] and report["frames"]["delivered"] > 20
    assert report["updates"]["count"] >= 3
    used = [json.loads(line) for line in (run.out / "processes.jsonl").read_text().splitlines()]
    assert all(used[-1][name]["rss_mb"] > 10 for name in ("node", "emulator", "edge"))
    assert not leftovers(run.out)
    prepare(run.out, {}).close()  # knows all the names that a run writes


Asleep = Callable[..., launcher.Launcher]


@pytest.fixture
def asleep(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Asleep:
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


def test_a_process_that_dies_ends_the_run_is_named_and_the_others_are_stopped(
    asleep: Asleep, capfd: pytest.CaptureFixture[str]
) -> None:
    run = asleep("import os, time; print('so much'); time.sleep(0.8); os.kill(os.getpid(), 9)")
    assert run.run() == 1
    said, made = capfd.readouterr().out, run.processes
    assert "the node was killed by SIGKILL" in said and "  | so much" in said
    assert said.endswith("no report: the run did not start\n")
    assert not any(child.running for child in made.children) and made.emulator.process is None
    rows = [json.loads(line) for line in (run.options.out / "processes.jsonl").read_text().splitlines()]
    assert rows[0]["edge"]["pid"] == made.edge.pid and "machine" in rows[0]


def test_a_trouble_is_said_once_of_each_camera_though_its_numbers_change(asleep: Asleep) -> None:
    run, said = asleep("pass"), []
    run._say = said.append
    run.options.out.mkdir()
    first = [f"cam0{k}: its poses drift: the picture asks for 9 cm and .5 degrees" for k in range(2)]
    plugin = "policy Mine failed 3 times: all views were used"
    for troubles in ([*first, plugin], [first[0].replace("9 cm", "1e+03 cm"), plugin.replace("3", "14")]):
        (run.options.out / "edge.json").write_text(json.dumps({"troubles": troubles}))
        run._say_troubles()
    assert said == [f"note: {line}" for line in (*first, plugin)]


@pytest.mark.parametrize(
    ("last", "code", "text"),
    [("pass", 0, "the recording is over"), ("import os; os.kill(os.getpid(), 9)", 1, "the node was killed by SIGKILL")],
)
def test_a_recording_that_is_over_ends_the_run_well_and_a_kill_does_not(
    asleep: Asleep, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, last: str, code: int, text: str
) -> None:
    run = asleep(f"import time; time.sleep(0.5); {last}")
    # It is over before the first update: kernels are still being compiled.
    monkeypatch.setattr(
        run, "_continue_start", lambda now_s: run.processes.emulator.process or run.processes.emulator.start()
    )
    assert run.run() == code
    assert text in capfd.readouterr().out


def test_a_run_whose_lines_nobody_reads_ends_as_at_ctrl_c(asleep: Asleep, monkeypatch: pytest.MonkeyPatch) -> None:
    """``freshfield demo room | head -3``."""
    run = asleep(SLEEPS)
    edge, (reader, writer) = run.processes.edge, os.pipe()
    monkeypatch.setattr(edge, "start", lambda: (Child.start(edge), os.close(reader)))
    monkeypatch.setattr(sys, "stdout", os.fdopen(writer, "w"))
    assert run.run() == 0
    assert edge.process is not None and not any(child.running for child in run.processes.children)


@pytest.mark.slow  # 6 s
def test_ctrl_c_ends_a_run_with_its_report(up: Callable[..., Up]) -> None:
    run = up("--for", "0")
    run.wait_for_updates()
    run.process.send_signal(signal.SIGINT)
    assert run.end() == 0, run.output
    assert "stopping (Ctrl-C)" in run.output and "Traceback" not in run.output
    assert run.report()["frames"]["closes"]
    assert not leftovers(run.out)


def test_a_start_that_fails_says_why_and_costs_no_earlier_run(tmp_path: Path) -> None:
    prepare(tmp_path / "run", {}).close()
    (tmp_path / "run" / "report.json").write_text("{}")
    run = Up(tmp_path, "--policy", "foo")
    assert run.end() == 1
    assert "'foo' is not known" in run.output and "PSNR" not in run.output
    assert run.output.endswith(f"the run was never up; an earlier run's files are in {run.out / EARLIER}\n")
    assert (run.out / EARLIER / "report.json").exists()


def refusal(*words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "freshfield_up.cli", "demo", *words], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 2, done.stdout + done.stderr
    assert done.stderr.count("\n") == 1, "the message is one line"
    return done.stderr


def test_a_mistyped_scenario_is_refused_in_one_line(tmp_path: Path) -> None:
    file = tmp_path / "typo.yaml"
    file.write_text(SMALL.replace("cameras:", "camera:"))
    assert "did you mean 'cameras'?" in refusal(str(file), "--out", str(tmp_path / "run"))
    assert "shipped scenarios: " in refusal("no-such-scenario")


def test_a_taken_port_is_refused_before_anything_starts(tmp_path: Path) -> None:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        s.listen()
        text = refusal("room", "--out", str(tmp_path / "run"), "--port", str(s.getsockname()[1]))
    assert "is taken by another program" in text
    assert not (tmp_path / "run").exists()


def test_a_run_does_not_delete_the_policy_that_it_loads(tmp_path: Path) -> None:
    (out := tmp_path / "run").mkdir()
    (out / "run.json").write_text("{}")
    (learned := out / "learned.npz").write_bytes(b"weights")
    words = ("room", "--out", str(out), "--port", str(free_port()), "--policy", f"bandit:{learned}")
    assert "is emptied first; choose another --out" in refusal(*words)
    assert learned.read_bytes() == b"weights"


@pytest.mark.parametrize("text, seconds", [("60", 60.0), ("60s", 60.0), ("1.5m", 90.0), ("2h", 7200.0), ("0", 0.0)])
def test_times_are_read_as_people_write_them(text: str, seconds: float) -> None:
    from freshfield_up import demo_command as script

    assert script.seconds(text) == seconds


@pytest.mark.parametrize(("duration_s", "headline"), [(0.0, "12 s"), (60.0, "12 of 60 s")])
def test_a_line_says_how_much_of_its_time_a_run_has_run(tmp_path: Path, duration_s: float, headline: str) -> None:
    options = launcher.Options(tmp_path, duration_s=duration_s)
    run = launcher.Launcher(load(ROOT / "deploy" / "scenarios" / "room.yaml"), options)
    run._ready_s = 100.0
    assert run._headline(112.9) == headline


def test_a_deployment_in_a_script_says_why_it_cannot_start(tmp_path: Path) -> None:
    (tmp_path / "small.yaml").write_text(SMALL.replace("lpips: none", "policy: {name: nothing}"))
    with (
        pytest.raises(DeploymentError, match="the edge server"),
        ff.deployment(tmp_path / "small.yaml", out=tmp_path / "run"),
    ):
        pass
    with pytest.raises(ScenarioError, match="shipped scenarios"):
        ff.deployment("nothing")


@pytest.mark.parametrize(
    ("argv", "command"),
    [
        (["/usr/bin/freshfield", "demo", "my file"], "freshfield demo 'my file'"),
        (["/lib/freshfield_up/__main__.py", "demo"], "freshfield demo"),
        (["examples/deployment.py", "card", "6"], "python examples/deployment.py card 6"),
    ],
)
def test_the_record_names_the_command_that_can_be_given_again(argv: list[str], command: str) -> None:
    from freshfield_up.run import command_line

    assert command_line(argv) == command
