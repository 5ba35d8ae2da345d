"""Starting and stopping real processes; the four commands at Ctrl-C and when nobody reads their output."""

import os
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

from freshfield_up import console, processes
from freshfield_up.processes import Child
from tests.conftest import ROOT
from tests.support import wait_until


def python(tmp_path: Path, code: str, name: str = "one") -> Child:
    return Child(name, f"process {name}", [sys.executable, "-c", code], tmp_path / f"log-{name}.txt")


def test_a_child_becomes_its_command_and_runs_no_python_between_fork_and_exec(tmp_path, monkeypatch):
    """There it might wait forever for a lock that another thread of the launcher held."""
    options: list[str] = []
    start = subprocess.Popen
    monkeypatch.setattr(processes.subprocess, "Popen", lambda *a, **b: options.extend(b) or start(*a, **b))
    child = python(tmp_path, "import os, signal, sys; print(os.getpid(), sys.argv, signal.getsignal(signal.SIGTERM))")
    child.start()
    wait_until(lambda: not child.running, "it did not end")
    assert f"\n{child.pid} ['-c'] {int(signal.SIG_DFL)}\n" in child.log.read_text()
    assert "preexec_fn" not in options and "start_new_session" in options


def test_stop_terminates_first_and_kills_after_the_grace_time(tmp_path):
    answers = {"obedient": "lambda *_: sys.exit(print('goodbye'))", "stubborn": "signal.SIG_IGN"}
    code = "import signal, sys, time\nsignal.signal(signal.SIGTERM, {})\nprint('up')\ntime.sleep(60)"
    obedient, stubborn = (python(tmp_path, code.format(answer), name) for name, answer in answers.items())
    for child in (obedient, stubborn):
        child.start()
        wait_until(lambda child=child: "\nup\n" in child.log.read_text(), "it did not start")
    began = time.monotonic()
    processes.stop([obedient, stubborn], grace_s=1.0)
    assert time.monotonic() - began < 5.0
    assert not obedient.running and not stubborn.running
    assert not obedient.killed and obedient.process.returncode == 0 and "goodbye" in obedient.log.read_text()
    assert stubborn.killed and stubborn.process.returncode == -signal.SIGKILL


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells children that their parent is gone")
def test_no_child_outlives_a_launcher_that_was_killed_outright(tmp_path):
    launcher = """
import sys, time
from pathlib import Path
from freshfield_up.processes import Child
child = Child("c", "c", [sys.executable, "-c", "import time; time.sleep(60)"], Path(sys.argv[1]))
child.start()
print(child.pid, flush=True)
time.sleep(60)
"""
    deploy = Path(processes.__file__).parents[1]
    command = [sys.executable, "-c", launcher, str(tmp_path / "log.txt")]
    with subprocess.Popen(command, cwd=deploy, stdout=subprocess.PIPE) as parent:
        pid = int(parent.stdout.readline())
        assert Path(f"/proc/{pid}").exists()
        parent.kill()

    def ended() -> bool:
        try:
            return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] == "Z"
        except FileNotFoundError:
            return True

    wait_until(ended, "the child outlived its parent")


SCRIPTS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


def start(command: str, words: list[str], before: str = "", **streams: int) -> subprocess.Popen[bytes]:
    """The command as its installed script starts it. before: Python that runs first."""
    module, _, function = SCRIPTS[command].partition(":")
    code = f"import sys; sys.argv = {[command, *words]}; {before}\nimport {module}; sys.exit({module}.{function}())"
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, **streams)


@pytest.mark.parametrize("after_s", [0.05, 0.4])
def test_ctrl_c_while_it_starts_prints_no_traceback(after_s):
    words = ["simulate", "--preset", "ch6", "--seconds", "1e6"]
    process = start("channel-emu", words, "print(flush=True)", stdout=subprocess.PIPE)
    process.stdout.readline()  # Python itself has started
    time.sleep(after_s)
    process.send_signal(signal.SIGINT)
    errors = process.communicate(timeout=30)[1]
    assert b"Traceback" not in errors and b"ignored" not in errors
    if after_s == 0.05:
        assert process.returncode == -signal.SIGINT  # it was still importing


@pytest.mark.parametrize(
    ("command", "words", "unbuffered"),
    [("freshfield", ["scenario", "keys", "effects"], ""), ("channel-emu", ["presets"], "1")],
)
def test_output_that_nobody_reads_ends_it_without_a_word(command, words, unbuffered, tmp_path, monkeypatch):
    """Where it is buffered, the last of it is written at the end."""
    monkeypatch.setenv("PYTHONUNBUFFERED", unbuffered)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.chdir(tmp_path)
    reader, writer = os.pipe()
    os.close(reader)
    process = start(command, words, stdout=writer)
    os.close(writer)
    assert process.communicate(timeout=30)[1] == b""
    assert process.returncode == console.NOBODY_READS


def test_the_status_of_a_command_is_passed_on():
    process = start("freshfield", ["demo", "no-such-scenario"], stdout=subprocess.DEVNULL)
    assert b"no-such-scenario" in process.communicate(timeout=30)[1] and process.returncode == 2
