"""Who is served when: the line that one camera has to itself, or that several compete for.

A server transmits one frame at a time (``parallel``: any number up to the limit). Shared by several cameras,
the disciplines mean:

- drop-new: a frame that finds the line busy, with whichever camera's frame, is dropped.
- newest-waits: each camera has one waiting place, in which its newest frame replaces an older one.
- fcfs: each camera has a queue; ``queue_limit`` bounds the frames waiting in all of them.
- lcfs-preempt: a new frame of any camera throws out the frame in service, whoever's it is.
- parallel: nobody waits; ``queue_limit`` bounds the frames on their way of all cameras.

When the line falls free, ``order`` chooses the camera; within a camera frames keep their order:

- fcfs: who has waited longest. Under newest-waits a replacing frame inherits the turn of the one it replaces,
  or fast cameras would lose it for being fast.
- newest-first: whose next frame arrived last.
- round-robin: the next camera by name, after the one served last.
- oldest-age: whose newest delivered frame is oldest, never-delivered ones first (maximum age first: Sun,
  Uysal-Biyikoglu and Kompella, "Age-optimal updates of multiple information flows", INFOCOM workshops 2018).

What happens at one instant happens in this order: frames complete, streams reset, frames arrive (earlier
offers first, then by name).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from channel_emu.model.instants import NEVER_NS

if TYPE_CHECKING:
    from channel_emu.model.link import Link

ORDERS = ("fcfs", "newest-first", "round-robin", "oldest-age")


class Server:
    """Arbitrates between the links that joined it; what becomes of a frame is the link's to say."""

    def __init__(self, order: str = "fcfs", queue_limit: int = 1024) -> None:
        if order not in ORDERS:
            raise ValueError(f"order {order!r} is not one of {', '.join(ORDERS)}")
        self.order = order
        self.queue_limit = queue_limit
        self.busy = 0
        """Frames in service."""
        self.waiting = 0
        """Frames waiting, of all links."""
        self.served: Link | None = None
        """Whose frame was started last."""
        self.now_ns = 0
        self.links: list[Link] = []
        self._turn = 0

    @property
    def shared(self) -> bool:
        return len(self.links) > 1

    def join(self, link: Link) -> None:
        """Links stand in the order of their cameras' names, so that it does not matter who came first."""
        if any(link.camera == other.camera for other in self.links):
            raise ValueError(f"{link.camera} has a link to this server already")
        self.links = sorted([*self.links, link], key=lambda each: each.camera)

    def run_to(self, to_ns: int) -> None:
        """Everything that happens to any link up to and at an instant, in order."""
        if len(self.links) == 1:
            (link,) = self.links
            while (at_ns := link.own_event_ns) <= to_ns and at_ns < NEVER_NS:
                link.step()
            return
        while True:
            at_ns = min([link.own_event_ns for link in self.links])
            if at_ns > to_ns or at_ns >= NEVER_NS:
                return
            min((link for link in self.links if link.own_event_ns == at_ns), key=lambda x: x.urgency).step()

    def next_turn(self) -> int:
        """The number of an arrival."""
        self._turn += 1
        return self._turn

    def feed(self, at_ns: int) -> None:
        """The line may have fallen free: start who is next."""
        if self.waiting and not self.busy:
            self._choose().start_waiting(at_ns)

    def _choose(self) -> Link:
        ready = [link for link in self.links if link.waiting]
        if len(ready) == 1:
            return ready[0]
        if self.order == "fcfs":
            return min(ready, key=lambda link: link.waiting[0].turn)
        if self.order == "newest-first":
            return max(ready, key=lambda link: link.waiting[0].turn)
        if self.order == "oldest-age":
            return min(ready, key=lambda link: link.newest_delivered_ns)
        last = self.served.camera if self.served is not None else ""
        return next((link for link in ready if link.camera > last), ready[0])
