"""The clock a camera stamps its frames with: the machine's, or a deliberately wrong one."""

from __future__ import annotations

from typing import Protocol

from freshfield.clock import Clock


class Drifting(Protocol):
    """What shifts time: the effects of a camera."""

    def node_ns(self, true_ns: int) -> int: ...


class NodeClock:
    """``true`` seen through ``drift``; ``true`` itself without it."""

    def __init__(self, true: Clock, drift: Drifting | None = None) -> None:
        self._true = true
        self._drift = drift

    @property
    def true_to_machine(self) -> bool:
        return self._drift is None

    def now_ns(self) -> int:
        return self.stamp_ns(self._true.now_ns())

    def stamp_ns(self, true_ns: int) -> int:
        """What this clock shows at a true time."""
        return true_ns if self._drift is None else self._drift.node_ns(true_ns)
