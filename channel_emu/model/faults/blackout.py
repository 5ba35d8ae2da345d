"""Time windows without connection: a frame whose transmission overlaps one is lost."""

from __future__ import annotations

from typing import Annotated

from msgspec import field

from channel_emu.model.link import Fault, Transit
from channel_emu.model.nanoseconds import to_ns
from freshfield.settings import Settings, about


class Params(Settings, frozen=True):
    """Windows since the emulator started; in addition, one of ``for_ms`` at the end of each period of ``every_ms``."""

    windows_ms: Annotated[list[list[float]], about("[start, end] of each window")] = field(default_factory=list)
    every_ms: float | None = None
    for_ms: float | None = None
    cameras: Annotated[tuple[str, ...], about("whose links it concerns; not given: all")] = ()

    def __post_init__(self) -> None:
        for window in self.windows_ms:
            if len(window) != 2 or not 0 <= window[0] < window[1]:
                raise ValueError(f"windows_ms: expected [start, end] with 0 <= start < end, got {window}")
        if (self.every_ms is None) != (self.for_ms is None):
            raise ValueError("every_ms and for_ms go together")
        if self.every_ms is not None and self.for_ms is not None and not 0 < self.for_ms < self.every_ms:
            raise ValueError(f"for_ms: expected more than 0 and less than every_ms, got {self.for_ms:g}")
        if not self.windows_ms and self.every_ms is None:
            raise ValueError("expected windows_ms, or every_ms with for_ms")


class Blackout(Fault):
    def __init__(self, params: Params, seed: int, camera: str) -> None:
        concerned = not params.cameras or camera in params.cameras
        self.windows_ns = [(to_ns(a), to_ns(b)) for a, b in params.windows_ms if concerned]
        self.every_ns = to_ns(params.every_ms) if params.every_ms is not None and concerned else 0
        self.for_ns = to_ns(params.for_ms) if params.for_ms is not None else 0

    def loses(self, transit: Transit) -> bool:
        start, due = transit.started_ns, transit.due_ns
        assert start is not None and due is not None
        if any(start < b and due >= a for a, b in self.windows_ns):
            return True
        if not self.every_ns:
            return False
        # The window of period k is [(k + 1) every - for, (k + 1) every).
        next_window = (start // self.every_ns + 1) * self.every_ns - self.for_ns
        return due >= next_window
