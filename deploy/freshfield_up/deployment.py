"""A scenario's processes on this machine, run from a script.

with freshfield.deployment("room", seconds=60, out="runs/room") as run:
    print(run.page, run.status()["updates"])
print(run.report["fidelity"]["shown"])
"""

from __future__ import annotations

import json
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Any

from freshfield.files import read_status
from freshfield_up import launcher_constants as tuned
from freshfield_up.launcher import open_launcher
from freshfield_up.ports import LOOPBACK, free_ports
from freshfield_up.process_set import Options


class DeploymentError(RuntimeError):
    """The processes did not start, or one of them died; the message says which and names its log."""


class Deployment:
    """A running deployment, for ``with``: entering waits until everything is up, leaving ends it and writes the report.

    out: folder of the run. page: address of the live page.
    """

    def __init__(
        self,
        scenario: str | Path,
        *,
        seconds: float = 0.0,
        out: str | Path = "runs/deployment",
        port: int | None = None,
        data: Path | None = None,
        seed: int | None = None,
        policy: str | None = None,
        say: Callable[[str], None] = lambda line: None,
    ) -> None:
        """scenario: a file, or the name of a shipped one. seconds: after which it ends by itself; 0: it does not.
        out: replaces an earlier run in it. port: of the page; None: any free one. data: folder of recorded data sets.
        seed, policy: in place of the scenario's. say: gets the lines that ``freshfield demo`` prints.
        Raises ScenarioError."""
        self.out = Path(out)
        port = free_ports(1)[0] if port is None else port
        self.page = f"http://{LOOPBACK}:{port}"
        self._launcher = open_launcher(scenario, Options(self.out, seconds, port, data, seed, policy), say)
        self._thread = threading.Thread(target=self._run, name="deployment")
        self._ended = threading.Event()
        self._error: Exception | None = None

    def __enter__(self) -> Deployment:
        """Raises FolderError or MissingCommand where it cannot start, DeploymentError where a process fails."""
        self._thread.start()
        try:
            while not self._launcher.ready.wait(tuned.STARTED_POLL_S) and not self._ended.is_set():
                pass
        except BaseException:  # Ctrl-C while it starts
            self._end()
            raise
        self._check()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._end()
        if error is None:
            self._check()

    @property
    def running(self) -> bool:
        """Whether it goes on: its ``seconds`` are not over, and no process has died."""
        return not self._ended.is_set()

    def status(self) -> dict[str, Any]:
        """What the edge server says of itself now: ``cameras``, ``updates``, ``scores``, ``policy`` and others, as in
        edge.json."""
        return read_status(self.out / "edge.json")

    @property
    def report(self) -> dict[str, Any]:
        """The contents of report.json, which is written at the end; report.html lies beside it. Raises OSError while
        the run goes on."""
        found: dict[str, Any] = json.loads((self.out / "report.json").read_text())
        return found

    def _run(self) -> None:
        try:
            self._launcher.run()
        except Exception as error:  # belongs to the thread that waits
            self._error = error
        finally:
            self._ended.set()

    def _end(self) -> None:
        self._launcher.stop()
        self._thread.join()

    def _check(self) -> None:
        if self._error is not None:
            raise self._error
        if self._launcher.failures:
            self._end()
            raise DeploymentError("; ".join(self._launcher.failures))
