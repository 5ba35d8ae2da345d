"""The newest frame of each camera by generation time, still encoded, and its age.

Age of information (5.4, 5.5): now minus the generation time of the newest frame that has arrived. The newest
frames form the temporally inconsistent set Omega(t) of (5.6).
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from freshfield.frame import Frame
from freshfield.limits import MAX_CAPTURE_AHEAD_NS

MOST_UNSELECTED = 8  # frames of a camera that wait for a field that wants every frame


@dataclass(frozen=True)
class BufferedFrame:
    """A frame in the buffer. generated_ns is on the edge's clock (the node's offset added)."""

    frame: Frame
    generated_ns: int
    received_ns: int

    def age_ms(self, now_ns: int) -> float:
        return (now_ns - self.generated_ns) / 1e6


class FrameBuffer:
    """The newest frame of each training camera. Thread-safe.

    Memory is one encoded frame a camera, whatever arrives; two with ``keep_earlier``, MOST_UNSELECTED more
    with ``keep_every_frame``.
    arrivals: frames put in so far. stale_on_arrival: those that arrived after a newer one of their camera.
    shed: those that made room for newer ones before anything had selected them, with ``keep_every_frame``.
    """

    def __init__(self, cameras: Sequence[str]) -> None:
        self.cameras = tuple(cameras)
        self._newest: dict[str, BufferedFrame] = {}
        self._earlier: dict[str, BufferedFrame] = {}
        self._keep_earlier = False
        self._arrived = threading.Condition()
        self.arrivals = 0
        self.stale_on_arrival = 0
        self.shed = 0
        self._unselected: dict[str, deque[BufferedFrame]] | None = None

    def put(self, frame: Frame, received_ns: int) -> None:
        """Keep ``frame`` unless a newer one of its camera is here.

        A newer one dated after ``received_ns`` comes from a clock that has been corrected since, and is
        replaced: otherwise its camera would stand still until that time.
        """
        item = BufferedFrame(frame, frame.generated_edge_ns, received_ns)
        with self._arrived:
            known = self._newest.get(frame.camera)
            impossible = known is not None and known.generated_ns > received_ns + MAX_CAPTURE_AHEAD_NS
            if known is not None and not impossible and known.generated_ns >= item.generated_ns:
                self.stale_on_arrival += 1
                self._put_earlier(known, item)
            else:
                self._newest[frame.camera] = item
                if impossible:  # its capture time is unknown
                    self._earlier.pop(frame.camera, None)
                elif known is not None:
                    self._put_earlier(item, known)
            if self._unselected is not None:
                waiting = self._unselected[frame.camera]
                self.shed += len(waiting) == MOST_UNSELECTED
                waiting.append(item)
            self.arrivals += 1
            self._arrived.notify_all()

    def _put_earlier(self, newest: BufferedFrame, before: BufferedFrame) -> None:
        """Keep the newest frame before a camera's newest, whichever of the two arrived first."""
        known = self._earlier.get(before.frame.camera)
        older = before.generated_ns < newest.generated_ns
        if self._keep_earlier and older and (known is None or known.generated_ns < before.generated_ns):
            self._earlier[before.frame.camera] = before

    def keep_earlier(self, wanted: bool) -> None:
        """Whether to keep, from now on, the frame before each camera's newest as well. Policies that treat
        stale views compare the two."""
        with self._arrived:
            self._keep_earlier = wanted
            if not wanted:
                self._earlier.clear()

    def keep_every_frame(self) -> None:
        """Keep, from now on, every frame until it is taken by ``take_unselected``."""
        with self._arrived:
            self._unselected = {camera: deque(maxlen=MOST_UNSELECTED) for camera in self.cameras}

    def take_unselected(self, selected: Sequence[BufferedFrame]) -> list[BufferedFrame]:
        """Drop what has arrived up to the newest of ``selected``; of that, return the other frames of their
        cameras, in the order of their arrival. Nothing without ``keep_every_frame``."""
        until_ns = max((item.received_ns for item in selected), default=0)
        found: list[BufferedFrame] = []
        with self._arrived:
            for camera, waiting in (self._unselected or {}).items():
                cameras_own = next((item for item in selected if item.frame.camera == camera), None)
                while waiting and waiting[0].received_ns <= until_ns:
                    item = waiting.popleft()
                    if cameras_own is not None and item is not cameras_own:
                        found.append(item)
        return sorted(found, key=lambda item: item.received_ns)

    def newest_and_earlier(self) -> tuple[dict[str, BufferedFrame], dict[str, BufferedFrame]]:
        """``newest`` and, at the same instant, the frames before them by camera (see ``keep_earlier``)."""
        with self._arrived:
            return self.newest(), dict(self._earlier)

    def newest(self) -> dict[str, BufferedFrame]:
        """Omega(t): the newest frame of every camera that has reported, in the order of ``cameras``."""
        with self._arrived:
            return {c: self._newest[c] for c in self.cameras if c in self._newest}

    def ages_ms(self, now_ns: int) -> dict[str, float | None]:
        """Age of each camera (5.4); None for one that never reported."""
        newest = self.newest()
        return {c: newest[c].age_ms(now_ns) if c in newest else None for c in self.cameras}

    def wait(self, seen: int, timeout_s: float) -> int:
        """Sleep until ``arrivals`` exceeds ``seen``, or for ``timeout_s``. Returns ``arrivals``."""
        with self._arrived:
            self._arrived.wait_for(lambda: self.arrivals > seen, timeout_s)
            return self.arrivals
