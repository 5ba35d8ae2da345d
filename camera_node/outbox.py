"""Holds the one captured frame that waits to be sent, and counts the outcomes of all frames."""

from __future__ import annotations

import asyncio
from collections import Counter

from freshfield.clock import Clock
from freshfield.frame import Frame
from freshfield.ledger import Ledger


class Outbox:
    """One camera's newest unsent frame. Counts the events of all frames and writes them to the ledger.

    ledger: None writes none. clock: stamps the events.
    counts: numbers of frames captured, replaced, sent and broken, and of answers by outcome.
    """

    def __init__(self, camera: str, session: str, ledger: Ledger | None, clock: Clock) -> None:
        self.camera = camera
        self.session = session
        self.counts: Counter[str] = Counter()
        self._ledger = ledger
        self._clock = clock
        self._frame: Frame | None = None
        self._filled = asyncio.Event()
        self._emptied = asyncio.Event()
        self._emptied.set()

    @property
    def waiting(self) -> int:
        """Number of waiting frames: 0 or 1."""
        return int(self._frame is not None)

    def put(self, frame: Frame) -> None:
        """Offer a captured frame; it replaces one that still waits."""
        if self._frame is not None:
            # Recorded before ``captured``: a process killed in between leaves at most one frame waiting.
            self.record(self._frame.sequence, "replaced")
        self._frame = frame
        self.record(frame.sequence, "captured")
        self._filled.set()
        self._emptied.clear()

    async def wait_empty(self) -> None:
        """Wait until no frame waits, so that ``put`` replaces none."""
        await self._emptied.wait()

    async def wait_frame(self) -> None:
        """Wait until a frame waits."""
        await self._filled.wait()

    def take(self) -> Frame:
        """Take the waiting frame and record it as sent. Recording it before the write means that a killed
        process may leave a frame in flight, but never one that arrived without a record of being sent.
        Raises LookupError if no frame waits."""
        frame, self._frame = self._frame, None
        if frame is None:
            raise LookupError("no frame is waiting")
        self._filled.clear()
        self._emptied.set()
        self.record(frame.sequence, "sent")
        return frame

    def close(self) -> None:
        """At the node's end: record a frame that still waits as ``waiting`` in the ledger."""
        if self._frame is not None:
            self._write(self._frame.sequence, "waiting")

    def record(self, sequence: int, event: str, detail: str = "") -> None:
        """Count an event (an answer by its outcome, ``detail``) and write it to the ledger."""
        self.counts[detail if event == "answered" else event] += 1
        self._write(sequence, event, detail)

    def _write(self, sequence: int, event: str, detail: str = "") -> None:
        if self._ledger is not None:
            self._ledger.write(self._clock.now_ns(), self.camera, self.session, sequence, event, detail)
