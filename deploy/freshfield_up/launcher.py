"""One run from start to report: checks it, starts, supervises and stops its processes, then reports."""

from __future__ import annotations

import json
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from types import FrameType

from freshfield import scenario as scenarios
from freshfield.files import Lines, read_status
from freshfield.machine_load import LoadMeter
from freshfield.scenario import Scenario, ScenarioError
from freshfield_up import console, folder, ports
from freshfield_up import launcher_constants as tuned
from freshfield_up.child_process import Child, kill, stop
from freshfield_up.process_set import Options, ProcessSet, process_set, program
from freshfield_up.status import status_line, summarize

_LOADING, _COMPILING = "loading", "compiling"
"""Starts of the edge's status text until it can make a first update."""
_NUMBER = re.compile(r"(?<![^\s(])-?[0-9.,]+(?![^\s):;%])")
"""A word that is a number; digits of a camera's name are none."""


def print_line(text: str) -> None:
    """Print a line. Raises BrokenPipeError once if nobody reads them: the lines of stopping are then dropped."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        console.discard_output()
        raise


def command_line(argv: Sequence[str]) -> str:
    """The command that a run was started with, from ``sys.argv``: of ``freshfield``, or of a script that uses the
    library."""
    script = Path(argv[0])
    ours = script.name == "freshfield" or script.parent.name == "freshfield_up"  # python -m freshfield_up
    return shlex.join(["freshfield", *argv[1:]] if ours else ["python", *argv])


class Launcher:
    """Runs a scenario's processes. ``run`` may be called once.

    say: gets a line for people now and then.
    ready: set once everything is up. failures: what went wrong, a line each.
    """

    def __init__(self, scenario: Scenario, options: Options, say: Callable[[str], None] = print_line) -> None:
        self.scenario = scenario
        self.options = options
        self.processes: ProcessSet
        self.ready = threading.Event()
        self.failures: list[str] = []
        self._say = say
        self._signals: list[str] = []
        self._troubles_said: set[str] = set()
        self._stop_requested, self._hurry = threading.Event(), False
        self._began_s = time.monotonic()
        self._ready_s: float | None = None
        self._page_announced = self._compiling_announced = False

    def run(self) -> int:
        """Run to the end: until ``stop``, the run's duration or, in the main thread, a signal. Returns the exit code.
        Raises FolderError or MissingCommand before any process starts."""
        options = self.options
        self.processes = process_set(self.scenario, options)
        about = {"scenario": str(self.scenario.path), "seed": self.scenario.seed, "port": options.port}
        about["command"] = command_line(sys.argv)
        lock = folder.prepare(options.out, about)
        numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
        for number in numbers if threading.current_thread() is threading.main_thread() else ():
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # nohup
                signal.signal(number, self._on_signal)
        try:
            cameras = f"{len(self.scenario.training)} cameras"
            if self.scenario.held_out:
                cameras += f" + {len(self.scenario.held_out)} held out"
            self._say(f"{self.scenario.name}: {cameras}, seed {self.scenario.seed}")
            self._say(f"logs and results: {options.out}")
            try:
                # Nobody reads the lines any more: ends as at Ctrl-C.
                with suppress(BrokenPipeError), closing(Lines(options.out / "processes.jsonl")) as samples:
                    self._supervise(samples)
            finally:
                self._stop()
            self._report()
            if (earlier := options.out / folder.EARLIER).exists():
                self._say(f"the run was never up; an earlier run's files are in {earlier}")
        finally:
            lock.close()
        return 1 if self.failures else 0

    def stop(self) -> None:
        """End the run, from any thread; ``run`` returns once the report is written."""
        self._stop_requested.set()

    def _supervise(self, samples: Lines) -> None:
        """Start the processes, then check them every tick until there is a reason to stop. samples: of their load."""
        # The node renders ahead while the edge loads its libraries. The emulator starts last, so that no
        # frame is sent, and lost, before the edge can take it.
        self.processes.edge.start()
        for arm in self.processes.arms:
            arm.start()
        if not self.processes.arms:
            self.processes.node.start()
        load, next_line_s, next_sample_s = LoadMeter(), 0.0, 0.0
        while not self._stop_requested.wait(tuned.TICK_S):
            now_s = time.monotonic()
            # A short recording may be over while kernels are compiled, before the first update.
            node = self.processes.node.process
            if self.processes.emulator.process is not None and node is not None and node.poll() == 0:
                self._say("the recording is over")
                return
            if not self._check_alive():
                return
            if self._ready_s is None:
                self._continue_start(now_s)
                if self.failures:
                    return
            if now_s >= next_sample_s:
                next_sample_s = now_s + tuned.SAMPLE_EVERY_S
                running = {child.name: child.pid for child in self.processes.children if child.running and child.pid}
                samples.write(json.dumps(load.row(now_s - self._began_s, running)))
            if now_s >= next_line_s:
                next_line_s = now_s + tuned.LINE_EVERY_S
                line = status_line(self.options.out, len(self.scenario.cameras))
                self._say(f"[{self._headline(now_s)}] {line}")
                self._say_troubles()
            if self._ready_s and self.options.duration_s and now_s - self._ready_s >= self.options.duration_s:
                return

    def _say_troubles(self) -> None:
        """Say what the edge finds wrong with frames and poses, each kind once: numbers within change."""
        for line in read_status(self.options.out / "edge.json").get("troubles") or ():
            camera, _, words = str(line).partition(" ")
            kind = f"{camera} {_NUMBER.sub('', words)}"
            if kind not in self._troubles_said:
                self._troubles_said.add(kind)
                self._say(f"note: {line}")

    def _continue_start(self, now_s: float) -> None:
        """One step of the start: the node once its arm answers, the emulator once the edge serves, and the
        page's address once the page answers."""
        emulator = self.processes.emulator
        if self.processes.node.process is None and ports.accepts(self.processes.arm_address):
            self.processes.node.start()
        if emulator.process is None and ports.is_serving(self.processes.edge_address):
            emulator.start()
        if not self._page_announced and ports.page_answers(self.options.port):
            self._page_announced = True
            here, port, after_s = ports.LOOPBACK, self.options.port, now_s - self._began_s
            self._say(f"page: http://{here}:{port}   (after {after_s:.0f} s)")
            self._say(f"      from another machine first: ssh -L {port}:{here}:{port} THIS-MACHINE")
        if not self._compiling_announced and self._edge_doing().startswith(_COMPILING):
            self._compiling_announced = True
            self._say("the field's kernels are compiled for this processor, once: usually 20 to 50 s")
            self._say("      before a first run instead: freshfield warm-up")
        waited_for = self._waiting_for()
        if waited_for is None:
            self._ready_s = now_s
            self.ready.set()
            folder.forget_earlier(self.options.out)
            for driver in self.processes.drivers:
                driver.start()  # last: the arm must not begin its tour before the field can learn
        elif now_s - self._began_s > tuned.READY_WITHIN_S:
            self._fail(f"{waited_for.role} was not ready after {tuned.READY_WITHIN_S:.0f} s; see {waited_for.log}")

    def _waiting_for(self) -> Child | None:
        """The process that is not ready yet, if any."""
        if self.processes.emulator.process is None or not self._page_announced:
            return self.processes.edge
        if not ports.is_serving(self.processes.emulator_address):
            return self.processes.emulator
        phases = [read_status(file).get("phase") for file in self.options.out.glob("node-*.json")]
        if "streaming" not in phases:
            return self.processes.node
        return self.processes.edge if self._edge_doing().startswith((_LOADING, _COMPILING)) else None

    def _edge_doing(self) -> str:
        """What the edge server says that it does."""
        return str(read_status(self.options.out / "edge.json").get("doing") or _LOADING)

    def _check_alive(self) -> bool:
        """Whether no process has ended."""
        for child in self.processes.children:
            if child.process is not None and not child.running:
                self._fail(child.exit_summary())
        return not self.failures

    def _fail(self, text: str) -> None:
        self.failures.append(text)
        self._say(text)

    def _headline(self, now_s: float) -> str:
        if self._ready_s is None:
            if self.processes.emulator.process is None:
                return "starting: the edge server loads, the cameras prepare their frames"
            return "starting: the cameras prepare their frames, the field its kernels"
        end = f" of {self.options.duration_s:.0f}" if self.options.duration_s else ""
        return f"{int(now_s - self._ready_s)}{end} s"

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        # A flag, since an event that is set where its own thread waits for it may never return; and Ctrl-C alone, since
        # a terminal that is closed sends SIGHUP twice.
        self._hurry |= bool(self._signals) and number == signal.SIGINT
        self._signals.append(signal.Signals(number).name)
        self._stop_requested.set()

    def _stop(self) -> None:
        """Stop the node first and the edge last, so that frames on the way arrive. A second Ctrl-C kills what still
        runs."""
        why = {"SIGINT": "Ctrl-C", "SIGTERM": "SIGTERM", "SIGHUP": "the terminal was closed"}
        reason = f" ({why[self._signals[0]]})" if self._signals else ""
        self._say(f"stopping{reason}: cameras, channel, edge")
        for group in self.processes.groups:
            stop(group, tuned.GRACE_S, lambda: self._hurry)
            for child in group:
                if child.killed:
                    self._say(f"{child.role} did not end in time and was killed; see {child.log}")

    def _report(self) -> None:
        """Write the report, also after a failure, if the run was up; a Ctrl-C meanwhile ends it."""
        out = self.options.out
        if self.failures and self._ready_s is None:
            self._say("no report: the run did not start")
            return
        if not any(out.glob("ledger-*.tsv")):
            self._say("no report: no process has written about a frame")
            return
        report = Child("report", "the report", [program("edge-server"), "report", str(out)], out / "log-report.txt")
        before, until_s = len(self._signals), time.monotonic() + tuned.REPORT_WITHIN_S
        try:
            report.start()
        except OSError as error:
            self._fail(f"no report: {report.log}: {error.strerror}")
            return
        while report.running and signal.SIGINT.name not in self._signals[before:]:
            if time.monotonic() > until_s:
                kill(report)
                self._fail(f"the report was not ready after {tuned.REPORT_WITHIN_S:.0f} s; see {report.log}")
                return
            time.sleep(tuned.STOPPED_POLL_S)
        if report.running:
            kill(report)
            self._fail(f"no report (Ctrl-C); to write it: edge-server report {out}")
            return
        assert report.process is not None
        if report.process.returncode != 0:
            self._fail(report.exit_summary())
            return
        self._say(summarize(out))


def open_launcher(scenario: str | Path, options: Options, say: Callable[[str], None] = print_line) -> Launcher:
    """A launcher, checked and not started. scenario: file or name. say: see ``Launcher``. Raises ScenarioError."""
    opened = scenarios.load(scenario, options.seed)
    ports.check_free(options.port)
    if options.data is not None and not options.data.is_dir():
        raise ScenarioError(f"{options.data}: no such folder of recorded data (--data)")
    kind, _, file = (options.policy or "").partition(":")
    if kind == "bandit" and Path(file).expanduser().resolve().is_relative_to(options.out.resolve()):
        raise ScenarioError(f"--policy {options.policy}: {options.out} is emptied first; choose another --out")
    return Launcher(opened, options, say)
