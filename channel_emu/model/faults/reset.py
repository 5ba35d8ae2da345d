"""Resets the camera's stream: frames inside the link are broken, and the node has to reconnect."""

from __future__ import annotations

from dataclasses import dataclass, field

from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.link import Fault
from channel_emu.model.nanoseconds import NEVER_NS, saturating_add, saturating_round, to_ns


@dataclass(frozen=True)
class Params:
    mean_interval_ms: float | None = None
    """Resets at the instants of a Poisson process with this mean interval, independent for each camera."""
    at_ms: list[float] = field(default_factory=list)
    """Or at these instants, in ms since the emulator started."""

    def __post_init__(self) -> None:
        if (self.mean_interval_ms is None) == (not self.at_ms):
            raise ValueError("expected either mean_interval_ms or at_ms")
        # Faster than this a node cannot reconnect in between.
        if self.mean_interval_ms is not None and self.mean_interval_ms < 10.0:
            raise ValueError(f"mean_interval_ms: expected at least 10, got {self.mean_interval_ms:g}")
        if any(at < 0 for at in self.at_ms):
            raise ValueError("at_ms: expected no negative instants")


class Effect(Fault):
    def __init__(self, params: Params, seed: int, camera: str) -> None:
        self.mean_ns = None if params.mean_interval_ms is None else params.mean_interval_ms * 1e6
        self.at_ns = sorted({to_ns(at) for at in params.at_ms})
        self.rng = CounterRng(seed, camera, "channel.reset")
        self._number, self._next_ns = 0, -1

    def next_reset_ns(self, after_ns: int) -> int:
        if self.mean_ns is None:
            return next((at for at in self.at_ns if at > after_ns), NEVER_NS)
        while self._next_ns <= after_ns:
            step = saturating_round(self.rng.exponential(self._number) * self.mean_ns)
            self._next_ns = saturating_add(max(self._next_ns, 0), max(step, 1))
            self._number += 1
        return self._next_ns
