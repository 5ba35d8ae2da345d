"""Starting, stopping and describing the exit of real processes."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import pytest

from freshfield_up import processes
from freshfield_up.processes import Child
from tests.waiting import wait_until


def python(tmp_path: Path, code: str, name: str = "one") -> Child:
    return Child(name, f"process {name}", [sys.executable, "-c", code], tmp_path / f"log-{name}.txt")


def test_the_exit_summary_names_the_exit_code_and_the_last_lines(tmp_path: Path) -> None:
    child = python(tmp_path, "print('reading'); raise SystemExit('the lens cap is on')")
    child.start()
    wait_until(lambda: not child.running, "it did not end")
    text = child.exit_summary()
    assert "process one ended by itself with exit code 1" in text
    assert "| the lens cap is on" in text and "| reading" in text
    assert str(child.log) in text


def test_the_exit_summary_names_the_signal(tmp_path: Path) -> None:
    child = python(tmp_path, "import time; time.sleep(60)")
    child.start()
    os.kill(child.pid, signal.SIGKILL)
    wait_until(lambda: not child.running, "it did not end")
    assert "killed by SIGKILL" in child.exit_summary()
    assert "wrote nothing" in child.exit_summary()


def test_stop_terminates_first_and_kills_after_the_grace_time(tmp_path: Path) -> None:
    obedient = python(
        tmp_path,
        "import signal, sys, time\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(print('goodbye')))\n"
        "print('up')\ntime.sleep(60)",
        "obedient",
    )
    stubborn = python(
        tmp_path,
        "import signal, time\nsignal.signal(signal.SIGTERM, signal.SIG_IGN)\nprint('up')\ntime.sleep(60)",
        "stubborn",
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
    wait_until(lambda: not _lives(pid), "the child outlived its parent")


def _lives(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"  # a zombie has ended


def test_the_tail_of_a_large_log_has_whole_lines_only(tmp_path: Path) -> None:
    log = tmp_path / "log.txt"
    log.write_text("$ the command\n" + "".join(f"line {i} äöü\n" for i in range(20_000)))
    lines = processes.tail(log, 5)
    assert lines == [f"line {i} äöü" for i in range(19_995, 20_000)]
    assert processes.tail(tmp_path / "missing", 5) == []


def test_grpc_does_not_act_when_a_process_starts(tmp_path: Path) -> None:
    """With gRPC's fork handlers, the launcher sometimes hung between two processes."""
    code = """
        import subprocess, sys
        from concurrent import futures
        from freshfield_up import net
        import grpc
        server = grpc.server(futures.ThreadPoolExecutor(1))
        port = server.add_insecure_port("127.0.0.1:0")
        server.start()
        net.is_serving(f"127.0.0.1:{port}")
        for _ in range(3):
            subprocess.run([sys.executable, "-c", ""], preexec_fn=lambda: None)
        server.stop(0)
    """
    found = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert found.returncode == 0 and "fork" not in found.stderr, found.stderr
