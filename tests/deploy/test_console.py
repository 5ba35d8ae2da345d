"""The four commands at Ctrl-C and when nobody reads their output, each in a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import tomllib

import pytest

from freshfield_up import console
from tests.conftest import ROOT


def start(command: str, words: list[str], before: str = "", **streams: int) -> subprocess.Popen[bytes]:
    """The command as its installed script starts it. before: Python that runs first."""
    module, _, function = scripts()[command].partition(":")
    code = f"import sys; sys.argv = {[command, *words]}; {before}\nimport {module}; sys.exit({module}.{function}())"
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.PIPE, **streams)


def scripts() -> dict[str, str]:
    return tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]


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
