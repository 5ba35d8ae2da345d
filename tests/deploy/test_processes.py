"""Starting, stopping and describing the exit of real processes."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from freshfield_up import processes
from freshfield_up.processes import Child
from tests.support import wait_until


def python(tmp_path: Path, code: str, name: str = "one") -> Child:
    return Child(name, f"process {name}", [sys.executable, "-c", code], tmp_path / f"log-{name}.txt")


def test_a_child_becomes_its_command_and_runs_no_python_between_fork_and_exec(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There it might wait forever for a lock that another thread of the launcher held."""
    options: list[str] = []
    start = subprocess.Popen
    monkeypatch.setattr(processes.subprocess, "Popen", lambda *a, **b: options.extend(b) or start(*a, **b))
    child = python(tmp_path, "import os, signal, sys; print(os.getpid(), sys.argv, signal.getsignal(signal.SIGTERM))")
    child.start()
    wait_until(lambda: not child.running, "it did not end")
    assert f"\n{child.pid} ['-c'] {int(signal.SIG_DFL)}\n" in child.log.read_text()
    assert "preexec_fn" not in options and "start_new_session" in options


def test_stop_terminates_first_and_kills_after_the_grace_time(tmp_path: Path) -> None:
    answers = {"obedient": "lambda *_: sys.exit(print('goodbye'))", "stubborn": "signal.SIG_IGN"}
    obedient, stubborn = (
        python(
            tmp_path,
            f"import signal, sys, time\nsignal.signal(signal.SIGTERM, {answer})\nprint('up')\ntime.sleep(60)",
            name,
        )
        for name, answer in answers.items()
    )
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
def test_no_child_outlives_a_launcher_that_was_killed_outright(tmp_path: Path) -> None:
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
