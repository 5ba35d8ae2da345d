"""Resets the camera's stream: frames inside the link are broken, and the node has to reconnect."""

from __future__ import annotations

import math
from typing import Annotated

from msgspec import field

from channel_emu.model.counter_rng import CounterRng
from channel_emu.model.link import Fault
from channel_emu.model.nanoseconds import NEVER_NS, saturating_add, saturating_round, to_ns
from freshfield.settings import Settings, within

Instant = Annotated[float, within(0, math.inf, "since the emulator started")]


class Params(Settings, frozen=True):
    """Resets by a Poisson process, independent for each camera, or at given instants."""

    # Faster than this a node cannot reconnect in between.
    mean_interval_ms: Annotated[float, within(10, math.inf, "between resets")] | None = None
    at_ms: list[Instant] = field(default_factory=list)

    def __post_init__(self) -> None:
        if (self.mean_interval_ms is None) == (not self.at_ms):
            raise ValueError("expected either mean_interval_ms or at_ms")


class Reset(Fault):
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
