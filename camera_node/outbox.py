"""The one place where a captured frame waits, and the books kept about it."""

from __future__ import annotations

import asyncio
from collections import Counter

from freshfield.clock import Clock
from freshfield.frame import Frame
from freshfield.ledger import Ledger


class Outbox:
    """One camera's newest frame, and nothing else. Counts and writes what became of every frame.

    counts: captured, replaced, sent, broken, and one entry for each outcome of an answer.
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
        return int(self._frame is not None)

    def put(self, frame: Frame) -> None:
        """Offer a captured frame; it takes the place of one still waiting."""
        if self._frame is not None:
            # Before ``captured``, so that at no instant of a kill two frames would count as waiting.
            self.note(self._frame.sequence, "replaced")
        self._frame = frame
        self.note(frame.sequence, "captured")
        self._filled.set()
        self._emptied.clear()

    async def room(self) -> None:
        """Until no frame waits, so that ``put`` replaces none."""
        await self._emptied.wait()

    async def wait(self) -> None:
        """Until a frame waits."""
        await self._filled.wait()

    def take(self) -> Frame:
        """The waiting frame, which counts as sent from now on: a process killed between this and the
        write leaves a frame in flight, never one that arrived without having been sent."""
        frame, self._frame = self._frame, None
        if frame is None:
            raise LookupError("no frame is waiting")
        self._filled.clear()
        self._emptied.set()
        self.note(frame.sequence, "sent")
        return frame

    def note(self, sequence: int, event: str, detail: str = "") -> None:
        """Count an event and write it down."""
        self.counts[detail if event == "answered" else event] += 1
        if self._ledger is not None:
            self._ledger.write(self._clock.now_ns(), self.camera, self.session, sequence, event, detail)
