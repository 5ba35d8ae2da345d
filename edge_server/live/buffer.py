"""What the edge knows of each camera: its newest frame by generation time, still encoded, and its age.

Age of information (5.4, 5.5): now minus the generation time of the newest frame that has arrived. The set
of newest frames is the temporally inconsistent set Omega(t) of (5.6).
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass

from freshfield.frame import Frame
from freshfield.payload import MAX_FUTURE_NS


@dataclass(frozen=True)
class Buffered:
    """A frame in the buffer. generated_ns is on the edge's clock (the node's offset added)."""

    frame: Frame
    generated_ns: int
    received_ns: int

    def age_ms(self, now_ns: int) -> float:
        return (now_ns - self.generated_ns) / 1e6


class FrameBuffer:
    """Newest frame per training camera. Memory is one encoded frame a camera, whatever arrives; two where the
    frame before the newest is asked for (``keep_earlier``).

    Thread-safe; ``wait`` lets the loop sleep until something arrives.
    """

    def __init__(self, cameras: Sequence[str]) -> None:
        self.cameras = tuple(cameras)
        self._newest: dict[str, Buffered] = {}
        self._earlier: dict[str, Buffered] = {}
        self._keep_earlier = False
        self._arrived = threading.Condition()
        self.arrivals = 0
        self.stale_on_arrival = 0
        """Frames that arrived after a younger one of the same camera; delivered, but never newest."""

    def put(self, frame: Frame, received_ns: int) -> None:
        """Keep ``frame`` if no younger one of its camera is here.

        A younger one that lies in the future of ``received_ns`` was dated by a clock that has been put right
        since, and gives way: else its camera would stand still until that future has come.
        """
        item = Buffered(frame, frame.generated_edge_ns, received_ns)
        with self._arrived:
            known = self._newest.get(frame.camera)
            impossible = known is not None and known.generated_ns > received_ns + MAX_FUTURE_NS
            if known is not None and not impossible and known.generated_ns >= item.generated_ns:
                self.stale_on_arrival += 1
                self._follow_up(known, item)
            else:
                self._newest[frame.camera] = item
                if impossible:  # nothing is known of when it was taken
                    self._earlier.pop(frame.camera, None)
                elif known is not None:
                    self._follow_up(item, known)
            self.arrivals += 1
            self._arrived.notify_all()

    def _follow_up(self, newest: Buffered, before: Buffered) -> None:
        """Keep the youngest frame that is older than a camera's newest: what overtook it on the way does not
        make it useless."""
        known = self._earlier.get(before.frame.camera)
        older = before.generated_ns < newest.generated_ns
        if self._keep_earlier and older and (known is None or known.generated_ns < before.generated_ns):
            self._earlier[before.frame.camera] = before

    def keep_earlier(self, wanted: bool) -> None:
        """From now on, keep the frame before each camera's newest as well (policies that treat stale views
        compare the two), or keep it no longer."""
        with self._arrived:
            self._keep_earlier = wanted
            if not wanted:
                self._earlier.clear()

    def newest_and_earlier(self) -> tuple[dict[str, Buffered], dict[str, Buffered]]:
        """Omega(t) as ``newest`` gives it and, at the same instant, the frame before of every camera that has
        one (``keep_earlier``)."""
        with self._arrived:
            newest = {c: self._newest[c] for c in self.cameras if c in self._newest}
            return newest, dict(self._earlier)

    def newest(self) -> dict[str, Buffered]:
        """Omega(t): newest frame of every camera that has reported, in the cameras' order."""
        with self._arrived:
            return {c: self._newest[c] for c in self.cameras if c in self._newest}

    def ages_ms(self, now_ns: int) -> dict[str, float | None]:
        """Age per camera (5.4); None for a camera that never reported."""
        newest = self.newest()
        return {c: newest[c].age_ms(now_ns) if c in newest else None for c in self.cameras}

    def wait(self, seen: int, timeout_s: float) -> int:
        """Sleep until more than ``seen`` frames have arrived in all, or the time is up; returns the count."""
        with self._arrived:
            self._arrived.wait_for(lambda: self.arrivals > seen, timeout_s)
            return self.arrivals
