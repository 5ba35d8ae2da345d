"""The newest frame of each camera by generation time, still encoded, and its age.

Age of information (5.4, 5.5): now minus the generation time of the newest frame that has arrived. The newest
frames form the temporally inconsistent set Omega(t) of (5.6).
"""

from __future__ import annotations

import math
import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import replace

from edge_server.live import live_constants as tuned
from freshfield.frame import Frame
from freshfield.limits import MAX_CAPTURE_AHEAD_NS


class FrameBuffer:
    """The newest frame of each training camera. Thread-safe.

    Memory is one encoded frame per camera, whatever arrives; ``MOST_UNSELECTED`` more with ``keep_every_frame``.
    arrivals: frames put in so far. stale_on_arrival: those that arrived after a newer one of their camera.
    held_back: frames beyond the limit of the last ``take``, which keep waiting.
    shed: frames left out for lack of time since the first ``take``, with ``keep_every_frame``.
    """

    def __init__(self, cameras: Sequence[str]) -> None:
        self.cameras = tuple(cameras)
        self._newest: dict[str, Frame] = {}
        self._arrived = threading.Condition()
        self.arrivals = 0
        self.stale_on_arrival = 0
        self.shed = 0
        self.held_back = 0
        self._unselected: dict[str, deque[Frame]] | None = None
        self._takes = 0
        self._held: Counter[str] = Counter()  # by camera, of ``held_back``
        self._last_take = dict.fromkeys(self.cameras, 0.0)  # the last one that took a frame of each camera

    def put(self, frame: Frame, received_ns: int) -> None:
        """Keep ``frame`` unless a newer one of its camera is in the buffer.

        A newer one dated after ``received_ns`` comes from a clock that has been corrected since, and is
        replaced: otherwise its camera would appear frozen until that time.
        """
        item = replace(frame, received_ns=received_ns)
        with self._arrived:
            known = self._newest.get(frame.camera)
            impossible = known is not None and known.generated_edge_ns > received_ns + MAX_CAPTURE_AHEAD_NS
            if known is not None and not impossible and known.generated_edge_ns >= item.generated_edge_ns:
                self.stale_on_arrival += 1
            else:
                self._newest[frame.camera] = item
            if self._unselected is not None:
                waiting = self._unselected[frame.camera]
                if len(waiting) == tuned.MOST_UNSELECTED and self._takes > 0:
                    self.shed += 1
                    self._held[frame.camera] -= self._held[frame.camera] > 0
                waiting.append(item)
            self.arrivals += 1
            self._arrived.notify_all()

    def keep_every_frame(self, wanted: bool) -> None:
        """Whether to keep, from now on, every frame until ``take``."""
        with self._arrived:
            if wanted != (self._unselected is not None):
                self._unselected = (
                    {camera: deque(maxlen=tuned.MOST_UNSELECTED) for camera in self.cameras} if wanted else None
                )
                self._held, self.held_back = Counter(), 0

    def take(
        self, selected: Sequence[Frame], most: int | None = None, moving: Mapping[str, float] | None = None
    ) -> tuple[tuple[Frame, ...], tuple[Frame, ...]]:
        """Take frames for an update.

        selected: newest frames that the policy selected.
        most: largest number of frames to take that were not taken before; None: all.
        moving: by camera, the share of its image that moves; 1 if unknown.
        Returns the frames of ``selected`` to use, and the other frames of their cameras that had arrived by
        then, in the order of their arrival. Without ``keep_every_frame`` these are ``selected`` and none.

        ``most`` admits the newest frame of each camera first, then the second newest of each, and so on.
        Frames of equal rank go in this order: cameras without a frame in the last ``LONGEST_WAIT`` takes, the
        longest wait first; then by the share of the image that moves, discounted by the frame's age
        (``FADES_MS``); among equals, the camera that has waited longest. Frames beyond ``most`` stay queued behind
        the next ``take``'s newer frames, so a burst is worked off later. Beyond ``MOST_UNSELECTED`` of a camera, the
        oldest are dropped and counted in ``shed``. Frames of cameras that were not selected are dropped; those that
        had waited for lack of time are counted, too.
        """
        until_ns = max((item.received_ns for item in selected), default=0)
        own = {item.camera: item for item in selected}
        youngest_ns = max((item.generated_edge_ns for item in selected), default=0)
        ranked: list[tuple[tuple[float, ...], Frame]] = []
        with self._arrived:
            if self._unselected is None:
                self.held_back = 0
                return tuple(selected), ()
            self._takes += 1
            for camera, waiting in self._unselected.items():
                arrived: list[Frame] = []
                while waiting and waiting[0].received_ns <= until_ns:
                    arrived.append(waiting.popleft())
                if camera not in own:
                    self.shed += min(self._held[camera], len(arrived))
                else:
                    arrived.sort(key=lambda item: (-item.generated_edge_ns, item is not own[item.camera]))
                    last, share = self._last_take[camera], (moving or {}).get(camera, 1.0)
                    waits_on = self._takes - last <= tuned.LONGEST_WAIT
                    newest_was_taken = not any(item is own[camera] for item in arrived)
                    for k, item in enumerate(arrived, start=int(newest_was_taken)):
                        older_ms = max(youngest_ns - item.generated_edge_ns, 0) // tuned.AS_YOUNG_NS
                        worth = share * math.exp(-older_ms / tuned.FADES_MS) if waits_on else 0.0
                        ranked.append(((k, waits_on, -worth, last, -item.generated_edge_ns), item))
            ordered = [item for _, item in sorted(ranked, key=lambda one: one[0])]
            taken = ordered if most is None else ordered[:most]
            for k, item in enumerate(taken):  # within one take, the first camera has waited longest
                self._last_take[item.camera] = self._takes + k / len(taken)
            left = ordered[len(taken) :]
            self._held = Counter()
            for item in sorted(left, key=lambda item: -item.received_ns):
                self._unselected[item.camera].appendleft(item)
                self._held[item.camera] += 1
            self.held_back = self._held.total()
        others = [item for item in taken if item is not own[item.camera]]
        left_out = {id(item) for item in left}
        used = tuple(item for item in selected if id(item) not in left_out)
        return used, tuple(sorted(others, key=lambda item: item.received_ns))

    def observe(self) -> tuple[int, dict[str, Frame]]:
        """``arrivals`` and ``newest`` at one instant: the newest frames are among those counted."""
        with self._arrived:
            return self.arrivals, {c: self._newest[c] for c in self.cameras if c in self._newest}

    def newest(self) -> dict[str, Frame]:
        """Omega(t): the newest frame of every camera that has reported, in the order of ``cameras``."""
        return self.observe()[1]

    def ages_ms(self, now_ns: int) -> dict[str, float | None]:
        """Age of each camera (5.4); None for one that never reported."""
        newest = self.newest()
        return {c: newest[c].age_ms(now_ns) if c in newest else None for c in self.cameras}

    def wait(self, seen: int, timeout_s: float) -> int:
        """Sleep until ``arrivals`` exceeds ``seen``, or for ``timeout_s``. Returns ``arrivals``."""
        with self._arrived:
            self._arrived.wait_for(lambda: self.arrivals > seen, timeout_s)
            return self.arrivals
