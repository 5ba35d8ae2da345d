"""What long work says of its progress, in a terminal and in a pipe."""

from __future__ import annotations

import io

import pytest

from edge_server.progress import ProgressLine
from tests.support import wait_until


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_pipe_is_told_of_long_work_alone(monkeypatch):
    now, out = [0.0], io.StringIO()
    monkeypatch.setattr("edge_server.progress.time.perf_counter", lambda: now[0])
    line = ProgressLine(out)
    for stage, each_s in (("depth", 0.05), ("sharpen", 2.0), ("fuse", 0.05)):
        for step in range(11):
            line(stage, step / 10)
            now[0] += each_s
    assert out.getvalue() == "  sharpen: some 18 s\n"
    quiet = ProgressLine(out, quiet_in_pipe=True)
    for now[0], share in ((0.0, 0.0), (10.0, 0.1)):
        quiet("batch 1", share)
    assert out.getvalue() == "  sharpen: some 18 s\n"


def test_a_terminal_sees_the_time_spent_until_a_part_is_done_and_then_what_is_left(monkeypatch):
    monkeypatch.setattr("edge_server.progress.REDRAWN_S", 0.05)
    out = Terminal()
    line = ProgressLine(out)
    with line.running("compare"):
        wait_until(lambda: "compare      0 s " in out.getvalue(), "the line is not drawn again", 5.0)
        line("compare", 0.5)
        wait_until(lambda: " 50 %, 0 s left" in out.getvalue(), "what is left is not told", 5.0)
        line("compare", 1.0)
    assert out.getvalue().endswith(" \r") and "\n" not in out.getvalue()


@pytest.mark.parametrize("stage", ["images", None])
def test_an_error_leaves_nothing_in_the_line_and_the_same_stage_begins_anew(monkeypatch, stage):
    now, out = [0.0], Terminal()
    monkeypatch.setattr("edge_server.progress.time.perf_counter", lambda: now[0])
    line = ProgressLine(out)
    for began in (0.0, 100.0):
        now[0] = began
        with pytest.raises(KeyboardInterrupt), line.running(stage):
            line("images", 0.0)
            now[0] += 4.0
            line("images", 0.5)
            raise KeyboardInterrupt
        told = out.getvalue().split("\r")
        assert "4 s left" in told[-3] and told[-2].isspace() and not told[-1]
