"""The server that transmits frames, for one camera or shared by several.

A server transmits one frame at a time (``parallel``: any number up to the limit). If several cameras share
it, the disciplines mean:

- drop-new: a frame that finds the server busy with any camera's frame is dropped.
- newest-waits: each camera has a waiting place for one frame, where a newer frame replaces an older one.
- fcfs: each camera has a queue; ``queue_limit`` bounds the waiting frames of all cameras together.
- lcfs-preempt: a new frame of any camera ends the frame in service, of whichever camera.
- parallel: no frame waits; ``queue_limit`` bounds the frames in service of all cameras together.

When the server becomes free, it serves the camera that has waited longest; frames of one camera keep their
order. Under newest-waits a frame inherits the ticket of the one that it replaces; otherwise a fast camera
would lose its place with every frame.

Events at the same instant are processed in this order: frames complete, streams reset, frames arrive (earlier
offers first, then by camera name).
"""

from __future__ import annotations

from collections import deque
from typing import Any, Protocol

from channel_emu.model.nanoseconds import NEVER_NS


class QueuedLink(Protocol):
    """The part of ``link.Link`` that the server uses."""

    camera: str
    own_event_ns: int

    @property
    def waiting(self) -> deque[Any]: ...
    @property
    def tie_break(self) -> tuple[int, int]: ...
    def step(self) -> None: ...
    def start_waiting(self, at_ns: int) -> None: ...
    def preempt(self, at_ns: int) -> None: ...


class QueueServer:
    """Chooses among its links; each link decides the outcome of its own frames."""

    def __init__(self, queue_limit: int = 1024) -> None:
        """queue_limit: maximum number of frames waiting (fcfs) or in service (parallel)."""
        self.queue_limit = queue_limit
        self.busy = 0
        """Frames in service."""
        self.waiting = 0
        """Frames waiting in all links."""
        self.last_started: QueuedLink | None = None
        """The link whose frame was started last."""
        self.now_ns = 0
        self.links: list[QueuedLink] = []
        self._tickets = 0

    def add(self, link: QueuedLink) -> None:
        """Add a link, keeping them sorted by camera name. Raises ValueError for a second link of a camera."""
        if any(link.camera == other.camera for other in self.links):
            raise ValueError(f"{link.camera} has a link to this server already")
        self.links = sorted([*self.links, link], key=lambda each: each.camera)

    def advance_to(self, to_ns: int) -> None:
        """Process the events of all links up to and including ``to_ns``, in order."""
        if len(self.links) == 1:
            (link,) = self.links
            while (at_ns := link.own_event_ns) <= to_ns and at_ns < NEVER_NS:
                link.step()
            return
        while True:
            at_ns = min([link.own_event_ns for link in self.links])
            if at_ns > to_ns or at_ns >= NEVER_NS:
                return
            min((link for link in self.links if link.own_event_ns == at_ns), key=lambda x: x.tie_break).step()

    def issue_ticket(self) -> int:
        self._tickets += 1
        return self._tickets

    def start_next(self, at_ns: int) -> None:
        """Start the next waiting frame if the server is free."""
        if self.waiting and not self.busy:
            ready = (link for link in self.links if link.waiting)
            min(ready, key=lambda link: link.waiting[0].ticket).start_waiting(at_ns)
