"""How far long work is: one line of a terminal, and nearly nothing in a pipe."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

from edge_server import edge_constants as tuned


class ProgressLine:
    """One line of a terminal with the stage, its share, and the seconds that are left, or were spent until there is
    something to reckon with. In a pipe, nothing but the estimate of a stage that takes longer than LONG_WORK_S, once
    a second of it has passed; not even that if ``quiet_in_pipe``.
    """

    def __init__(self, stream: TextIO, quiet_in_pipe: bool = False) -> None:
        self._stream, self._terminal, self._quiet = stream, stream.isatty(), quiet_in_pipe
        self._stage, self._share = "", 0.0
        self._printed_s, self._changed_s, self._began = 0.0, 0.0, (0.0, 0.0)
        self._announced = False
        self._lock = threading.Lock()

    def __call__(self, stage: str, share: float) -> None:
        """Say that ``share`` of ``stage`` is done, in [0, 1]. A share below the last one begins the stage anew."""
        with self._lock:
            now = time.perf_counter()
            known = stage == self._stage and share >= self._share
            if not known or share != self._share:
                self._share, self._changed_s = share, now
            if not known:
                self._stage, self._began, self._announced = stage, (now, share), False
            if share >= 1.0 or not known or now - self._printed_s >= tuned.REDRAWN_S:
                self._print(now)

    @contextmanager
    def running(self, stage: str | None = None) -> Iterator[None]:
        """While ``stage`` runs, or those that are said within, redraw the line of a terminal although no part of it
        ends. The line is removed at the end, also after an error."""
        self._stage = ""  # the same one may have run before
        if stage is not None:
            self(stage, 0.0)
        ended = threading.Event()

        def redraw() -> None:
            while not ended.wait(tuned.REDRAWN_S):
                with self._lock:
                    if self._stage and self._share < 1.0:
                        self._print(time.perf_counter())

        drawer = threading.Thread(target=redraw, name="progress", daemon=True)
        if self._terminal:
            drawer.start()
        try:
            yield
        finally:
            ended.set()
            if self._terminal:
                drawer.join()
                if self._stage:
                    self(self._stage, 1.0)

    def _print(self, now: float) -> None:
        self._printed_s = now
        began_s, first = self._began
        done, left_s = self._share - first, 0.0
        if done > 0.0:  # at the pace so far, less what has passed since the last part ended
            left_s = (self._changed_s - began_s) * (1.0 - self._share) / done - (now - self._changed_s)
        if not self._terminal:
            if left_s > tuned.LONG_WORK_S and not self._announced and not self._quiet:
                self._announced = True
                print(f"  {self._stage}: some {left_s:.0f} s", file=self._stream, flush=True)
            return
        told = f", {max(left_s, 0.0):.0f} s left" if done > 0.0 else f", {now - began_s:.0f} s"
        # A stage without parts, or whose first takes long, has no share to show.
        rest = f"{100 * self._share:3.0f} %{told}" if self._share > 0.0 else f"{now - began_s:3.0f} s"
        line = f"\r  {self._stage:10} {rest:21}"
        if self._share >= 1.0:  # results follow
            line = "\r" + " " * len(line) + "\r"
        print(line, end="", file=self._stream, flush=True)
